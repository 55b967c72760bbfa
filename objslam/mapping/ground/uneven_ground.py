"""Find uneven ground below planar poses before the objects are known, and allow for it."""

import numpy as np

from objslam.config import Settings
from objslam.core.diagnostics import Ledger
from objslam.core.geometry import is_planar
from objslam.core.types import Log
from objslam.frontend.known_errors import coarse
from objslam.mapping.checks.agreement import Agreement, Part, agreement, bounded_part
from objslam.mapping.ground.common_tilt import SIGNIFICANT, CommonTilt, Uneven, common_tilt
from objslam.mapping.progress import Progress

_FIRST = Uneven(np.radians(1.0), 0.05)
"""The unevenness that is allowed for before the first estimate. With a smaller tilt, rougher ground takes more rounds. With
a larger tilt, things above each other become one point. Their heights look like tilt, so the next estimate is even larger.
From 4 degrees, the estimates ended at 14 on the flat floor between shelves. From 1 degree, they reached the true tilt, up to
6 degrees, in all simulated drives on rough ground."""
_ROUNDS = 8
"""The most estimates of the unevenness. More estimates are more exact and take longer."""
_SAME = 0.05
"""The change of the noise from the ground at which the rounds end, as a share. A larger share ends the rounds sooner."""
_FEWEST = 60
"""The fewest boxes of a log from which the ground is estimated. Fewer boxes agree by chance."""
_CROWD = 10.0
"""The largest crowd (`Part.crowd`) of an examined log. In a larger crowd, rays meet anywhere, and show nothing. At 8.5, the
tilt of two simulated drives between rows of trees was found, and a flat drive was found flat. A larger value examines more
logs."""
_LEAST = 0.5
"""The least noise that the ground must add to rays, as a multiple of their other noise. Less noise hardly changes a map. A
larger number allows for uneven ground less often."""
_LEAST_ALONE = 2.0
"""The value of `_LEAST` for a robot with odometry alone. A joint map absorbs small tilts by itself. More freedom for the
path costs true objects where labels are no names. Two rough orchards had 2.6 and 3.0, and their maps lost nearly all trees
if flat ground was assumed. A robot with legs had 1.7, and five flats had 0.6 to 0.9. Their maps were better if flat ground
was assumed. A larger number finds less rough ground."""
_EXPLAINED = 0.4
"""The least share of the boxes that must fit points on the found ground. With wrong input, fewer boxes fit, and the errors
that the rays of a pose share do not come from the ground. A larger share finds uneven ground in fewer logs."""


def with_uneven_ground(log: Log, settings: Settings, ledger: Ledger, progress: Progress) -> Settings:
    """Return settings whose `planar` has the unevenness of the ground that the boxes show, if it moves rays.

    The ledger gets a warning about uneven ground. The settings stay as they are if the poses are not planar, if
    `noise.ground` does not allow the estimate, or if the boxes do not show uneven ground clearly.
    """
    use, usual = settings.noise.ground, settings.planar == type(settings.planar)()
    if not (usual if use == "auto" else use) or (settings.mode == "fixed" and coarse(settings)):
        return settings
    progress("tilt of the robot", 0, 0)
    found = uneven_ground(log, settings)
    if found is None:
        return settings
    with_ground = _with(settings, found)
    tilt, z = (float(f"{value:.2g}") for value in (np.degrees(with_ground.planar.tilt), with_ground.planar.z))
    ledger.warn(
        f"the ground is uneven: the robot rolls and pitches by about {tilt:g} deg and rises by about {z:g} m, which its "
        "planar poses do not say. The sigmas allow for it; poses in 3D would be more exact"
    )
    return with_ground


def uneven_ground(log: Log, settings: Settings) -> Uneven | None:
    """Return how uneven the ground is below the poses of a log. None if they are not planar or no unevenness shows.

    Without a localisation, only short windows are examined, because the odometry drifts little in them.

    Things are points where rays meet. They are searched in a world that is flattened along z, where the tilt hardly matters.
    The tilt is estimated from these points (`common_tilt`). The points are then searched again with this tilt.
    """
    path = log.odometry if log.localization is None else log.localization
    boxes = [one.detections for one in log.cameras if one.detections is not None and len(one.detections.frame_stamps)]
    if path is None or not boxes or not is_planar(path.poses):
        return None
    part = bounded_part(log, settings)
    if part.boxes < _FEWEST or part.crowd > _CROWD:
        return None
    alone = log.localization is None
    found = _last_fit(part, settings, _LEAST_ALONE if alone else _LEAST)
    if found is None or (alone and not _in_both_halves(found[0], settings)):
        return None
    return found[1].lasting()


def _last_fit(part: Part, settings: Settings, least: float) -> tuple[Agreement, CommonTilt] | None:
    """Return the agreement and the tilt of the last round, None if the ground seems flat. least: the least noise that the
    ground must add to rays, as `_LEAST`."""
    now, last = _FIRST, None
    for _ in range(_ROUNDS):
        at = agreement(part, part.log, _with(settings, now))
        if at is None or at.share < _EXPLAINED:
            return None
        fit = common_tilt(at.keyframes, at.rays, at.point, at.points, settings.noise.prior)
        if fit is None or fit.ground.gain < SIGNIFICANT or fit.ground.share < least:
            return None
        settled = abs(np.log(fit.ground.share / max(now.share, 1e-9))) < _SAME
        now, last = fit.ground, (at, fit)
        if settled:
            break
    return last


def _in_both_halves(at: Agreement, settings: Settings) -> bool:
    """Return whether both halves of a log show uneven ground.

    A camera that is moved on the robot tilts all later rays. Without a localisation, this looks like uneven ground, but one
    half of the log has no such step.
    """
    stamps = at.keyframes.stamps[at.rays.keyframe]
    late = stamps > (stamps.min() + stamps.max()) / 2
    for half in (late, ~late):
        point = np.where(half, at.point, -1)
        fit = common_tilt(at.keyframes, at.rays, point, at.points, settings.noise.prior)
        if fit is None or fit.ground.gain < SIGNIFICANT or fit.ground.share < _LEAST:
            return False
    return True


def _with(settings: Settings, ground: Uneven) -> Settings:
    """Return settings with at least this unevenness."""
    of = settings.planar
    planar = {"tilt": max(of.tilt, ground.tilt), "z": max(of.z, ground.height), "seconds": ground.seconds}
    return settings.model_copy(update={"planar": of.model_copy(update=planar)})
