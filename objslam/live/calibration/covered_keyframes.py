"""Find the keyframes of a session that its paths cover at its end, as an offline run does."""

from dataclasses import dataclass

import numpy as np

from objslam.core.arrays import Bools, Floats, Ints
from objslam.core.geometry import interpolate, inverse
from objslam.core.trajectory import Trajectory
from objslam.core.types import Log
from objslam.frontend.localization.continued_localization import continued_by_odometry
from objslam.live.mapper.state import MapState


@dataclass(frozen=True)
class Covered:
    """The keyframes that the localisation of a session covers. Without a localisation, these are all keyframes.

    mask: (n,) whether each keyframe is covered. map_T_base: (n, 4, 4) the poses that the paths give. measured: the
    localisation as measured. localization: the localisation, also where the odometry bridges and continues it.
    """

    mask: Bools
    map_T_base: Floats
    measured: Trajectory | None
    localization: Trajectory | None


def while_running(m: MapState, rows: Ints) -> Covered:
    """Return which keyframes in these rows (n,) the session has localised so far. If the session has localised no keyframe,
    all keyframes are covered, and the result has no localisation."""
    k = m.keyframes
    if not k.localized.any():
        return Covered(np.ones(len(rows), dtype=bool), k.map_T_base[rows], None, None)
    localized = m.course.localized.trajectory()
    return Covered(k.localized[rows], k.map_T_base[rows], localized, localized)


def at_the_end(m: MapState, rows: Ints) -> Covered:
    """Return which keyframes in these rows (n,) the localisation covers where the odometry bridges and continues it.

    The odometry may continue the localisation over any distance, because the solve starts at the poses of the session.
    """
    k, settings = m.keyframes, m.given
    driven, localized = m.course.driven.trajectory(), m.course.localized.trajectory()
    if driven is None or localized is None:
        return while_running(m, rows)
    paths = Log(name="", cameras=(), odometry=driven, localization=localized)
    path = continued_by_odometry(paths, settings, whole=True).localization
    assert path is not None
    poses, on_path = interpolate(path.stamps, path.poses, k.sent[rows], settings.poses.max_gap)
    known = k.localized[rows]
    poses[known] = k.map_T_base[rows[known]]
    mask = on_path | known
    return Covered(mask, poses, localized, path) if mask.any() else while_running(m, rows)


def into_frame(m: MapState, rows: Ints, covered: Covered) -> Floats:
    """Return the pose (4, 4) of the session's frame in the frame of the keyframes covered at the end.

    The two frames differ if the localisation was too rare to localise a keyframe while the session ran. rows: (n,) the rows
    of the keyframes of `covered`.
    """
    first = np.flatnonzero(covered.mask)[:1]
    if covered.localization is None or m.keyframes.localized.any() or not len(first):
        return np.eye(4)
    row = rows[first[0]]
    session_T_camera = m.graph.poses(m.keyframes.id[[row]])[0]
    return np.asarray(covered.map_T_base[first[0]] @ m.keyframes.base_T_camera[row] @ inverse(session_T_camera))
