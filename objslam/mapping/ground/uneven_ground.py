"""Find uneven ground below planar poses before the objects are known, and allow for it."""

from dataclasses import replace

import numpy as np

from objslam.config import Settings
from objslam.core.diagnostics import Ledger
from objslam.core.geometry import is_planar
from objslam.core.ground.rise import rise_of
from objslam.core.types import Log
from objslam.frontend.known_errors import coarse
from objslam.mapping.checks.agreement import Agreement, Part, agreement, bounded_part
from objslam.mapping.ground.common_tilt import SIGNIFICANT, CommonTilt, Uneven, common_tilt
from objslam.mapping.progress import Progress

_FIRST = Uneven(np.radians(1.0), 0.05)
"""The ground that is allowed for before the first estimate. With a smaller tilt, rougher ground takes more rounds. With a
larger one, things above each other become one point. Their heights look like tilt, which confirms itself. From 4 degrees,
it ended at 14 on a flat floor between shelves. From 1 degree, it grew to 6 in all simulated drives on such
ground."""
_ROUNDS = 8
"""The most estimates. More rounds are more exact and take longer."""
_SAME = 0.05
"""The rounds end if the noise that the ground adds changes by at most this share. A larger share ends sooner."""
_FEWEST = 60
"""The fewest boxes of a log from which the ground is estimated. Fewer boxes agree by chance."""
_CROWD = 10.0
"""In a larger crowd (`Part.crowd`), rays meet anywhere, and show nothing. At 8.5, the tilt of two simulated drives between
rows of trees was found, and a flat one was flat. A larger value examines more logs."""
_LEAST = 0.5
"""The least noise that the ground must add to rays, as a multiple of their other noise. Less noise hardly changes a map. A
larger number allows for uneven ground less often."""
_LEAST_ALONE = 2.0
"""The same, if the robot has odometry alone. A joint map absorbs small tilts by itself, and more freedom for the path costs
true objects where labels are no names. Two rough orchards had 2.6 and 3.0, and lost nearly all trees on flat ground. A robot
with legs had 1.7 and five flats 0.6 to 0.9, and their maps were better without. A larger number finds less rough ground."""
_EXPLAINED = 0.4
"""The least share of the boxes that must fit a point on the ground that was found. With wrong input, fewer fit, and what
their poses share is not the ground. A larger share finds uneven ground in fewer logs."""


def with_uneven_ground(log: Log, settings: Settings, ledger: Ledger, progress: Progress) -> Settings:
    """Return settings whose `planar` has the unevenness of the ground that the boxes show, if it moves rays.

    The ledger gets a warning. The settings stay as they are if the poses are not planar, if `noise.ground` does not
    allow the estimate, or if the boxes do not show it clearly.
    """
    use, usual = settings.noise.ground, settings.planar == type(settings.planar)()
    if not (usual if use == "auto" else use) or (settings.mode == "fixed" and coarse(settings)):
        return settings
    progress("tilt of the robot", 0, 0)
    found = uneven_ground(log, settings)
    if found is None:
        return settings
    if settings.mode == "joint" and log.localization is not None:  # In fixed mode, the lasting errors contain the rise.
        path = log.localization
        rise = rise_of(path.stamps, path.poses, np.array([found.tilt]), np.array([found.seconds]))
        found = replace(found, height=float(np.hypot(found.height, rise)))
    with_ground = _with(settings, found)
    tilt, z = (float(f"{value:.2g}") for value in (np.degrees(with_ground.planar.tilt), with_ground.planar.z))
    ledger.warn(
        f"the ground is uneven: the robot rolls and pitches by about {tilt:g} deg and rises by about {z:g} m, which its "
        "planar poses do not say. The sigmas allow for it; poses in 3D would be more exact"
    )
    return with_ground


def uneven_ground(log: Log, settings: Settings) -> Uneven | None:
    """Return how uneven the ground is below the poses of a log, None if they are not planar or nothing shows it.

    Without a localisation, short windows are examined, in which the odometry is sure.

    Things are searched as points where rays meet, in a world that is flattened along z, so that the tilt hardly matters.
    The tilt is estimated from these points (`common_tilt`), and the points are searched again with this tilt.
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
    """Return the last points and the tilt that they show. None if the ground seems flat. least: as `_LEAST`."""
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
