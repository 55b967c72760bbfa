"""Test whether the boxes of a log were found in images of another distortion than the one in `camera.yaml`.

Detectors often work on rectified images, whose boxes have no distortion. If `camera.yaml` has the distortion of the raw
images, each ray is bent once too often, by degrees near the image's edge. The reverse mistake is a `camera.yaml` of zeros
beside boxes of raw images. With odometry alone, short windows hardly show the mistake, because few rays cross there. So a
solve with the other lens decides (`refuted.without_refuted`). The reverse mistake is tested only at a localisation, because
errors of the odometry look like a lens in windows.
"""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from objslam.config import Settings
from objslam.core.arrays import Floats
from objslam.core.camera import Camera, undistort
from objslam.core.types import CameraLog, Log
from objslam.mapping.checks.agreement import Agreement, Part, agreements
from objslam.mapping.checks.finding import Finding
from objslam.mapping.checks.hypotheses.hypothesis import Hypothesis, with_cameras
from objslam.mapping.checks.hypotheses.trials import Trial

LENS = "other distortion"
"""The name of the finding that boxes fit better with another distortion of the lens."""
_BENT = 0.02
"""The least angle (rad) by which the distortion of a tested camera must bend a ray at the middle of an edge of its image. A
smaller angle tests more cameras in vain, because noise hides their distortion."""
_BARREL = (-0.1, -0.2)
"""The first distortion coefficients of the lenses that are tried for a camera without distortion. Lenses with a field of
view of 50 to 80 degrees have -0.05 to -0.4. More coefficients take longer."""
_MORE = 0.05
"""The least growth of the score by another lens, at poses of a localisation. In 24 simulated logs with lenses of -0.3 to
0.1, the right lens raises the score by 0.06 to 0.19 where the mistake is large. A wrong lens raises it by at most 0.02. A
larger value finds fewer mistakes."""
_MORE_BOXES = 15
"""The least number of additional boxes that must fit, weighted as in the score. A larger number needs longer logs."""
_DOUBTED = 0.7
"""The score of a log at poses of a localisation below which a camera without distortion is tested. Right logs have 0.75 in
simulation. A larger value tests more right logs, which takes time."""
_IN_WINDOWS = -0.015
"""The least change of the score, in windows of odometry, if the distortion of the cameras is removed. With a larger change,
a solve tests the log. In simulated logs, the change is -0.01 to 0.03 with the mistake. In right logs with a strong
distortion, the change is at most -0.02. A larger value saves solves and finds fewer mistakes."""


def check_lens(part: Part, found: Agreement, settings: Settings) -> tuple[Finding, Trial] | None:
    """Return a finding and its trial if boxes fit better with another distortion, else None. found: the agreement of the
    part's log."""
    distorted = any(_bends(one.camera) for one in part.log.cameras if one.camera.sees_size)
    if not distorted and (part.drifts or found.score > _DOUBTED):
        return None
    tried = list(_lenses(part.log, distorted))
    logs = (one.put_right(part.log) for one in tried)
    trials = [
        Trial(hypothesis, other.score, other.share, None)
        for hypothesis, other in zip(tried, agreements(part, logs, settings), strict=True)
        if other is not None
    ]
    best = max(trials, key=lambda trial: trial.score, default=None)
    if best is None or best.hypothesis is None:
        return None
    gain = best.score - found.score
    if gain <= (_IN_WINDOWS if part.drifts else _MORE) or (not part.drifts and gain * found.boxes < _MORE_BOXES):
        return None
    message = f"the boxes fit better {best.hypothesis.what}: {best.hypothesis.cause}"
    return Finding(LENS, message, spoils=False, basis="lens"), best


def _lenses(log: Log, distorted: bool) -> Iterator[Hypothesis]:
    """Yield the hypotheses about the lenses of a log. distorted: whether a camera of the log has a distortion."""
    if distorted:
        yield Hypothesis(
            LENS,
            "without distortion",
            "they are probably of rectified images, and camera.yaml has the distortion of the raw images. Write zeros as "
            "its distortion_coefficients (for a bag: --rectified)",
            lambda log: _with_distortion(log, np.zeros(5)),
        )
        return
    if not any(one.camera.sees_size for one in log.cameras):
        return
    for first in _BARREL:
        yield Hypothesis(
            LENS,
            f"with a barrel distortion of about {first:g}",
            "they are probably of raw images, and camera.yaml has no distortion. Write the distortion_coefficients of the "
            "camera's calibration (for a bag: --raw)",
            lambda log, first=first: _with_distortion(log, np.array([first, 0.0, 0.0, 0.0, 0.0])),  # type: ignore[misc]
        )


def _with_distortion(log: Log, coefficients: Floats) -> Log:
    def changed(one: CameraLog) -> CameraLog:
        if not one.camera.sees_size:
            return one
        camera = replace(one.camera, distortion_model="plumb_bob", distortion=coefficients)
        return replace(one, camera=camera)

    return with_cameras(log, changed)


def _bends(camera: Camera) -> bool:
    """Return whether the distortion of a camera bends rays so much that boxes can show it."""
    if camera.distortion_model != "equidistant" and not camera.distortion.any():
        return False
    middle, size = camera.matrix[:2, 2], camera.size
    edge = np.array([[0.0, middle[1]], [size[0], middle[1]], [middle[0], 0.0], [middle[0], size[1]]])
    bent, valid = undistort(camera, edge)
    straight, _ = undistort(replace(camera, distortion_model="plumb_bob", distortion=np.zeros(5)), edge)
    if not valid.any():
        return False
    return bool(np.arccos(np.clip((bent * straight).sum(axis=1), -1, 1))[valid].max() > _BENT)
