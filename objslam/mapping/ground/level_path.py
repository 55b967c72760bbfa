"""Level a map that was solved from planar odometry alone.

Rays and odometry measure how a robot tilts relative to its first pose. They do not say how the first pose tilts, so a solve
holds the first pose level. But a robot that accelerates, or stands on a bump, tilts by a degree. The heights of all things
20 m away would then be wrong by 0.3 m. So a floor is taken as level where the robot is level on average.
"""

from dataclasses import replace
from typing import Any

import numpy as np

from objslam.core.arrays import Floats
from objslam.core.geometry import is_planar
from objslam.core.rotation import quaternion_from_rotation, rotation_from_vector
from objslam.core.types import Keyframes
from objslam.mapping.solution import Solution


def has_free_tilt(keyframes: Keyframes) -> bool:
    """Return whether nothing measures how the first pose tilts: the poses are planar odometry, without a localisation."""
    return not keyframes.localized_every and is_planar(keyframes.map_T_base)


def levelled(solution: Solution) -> Solution:
    """Return a solution without bodies, turned about its first pose so that the robot is level on average.

    The turned solution fits all measurements equally well. With a localisation, or with poses that are not planar, the
    measured poses say how the robot tilts. The solution then stays as it is.
    """
    keyframes, estimate = solution.keyframes, solution.estimate
    if not has_free_tilt(keyframes):
        return solution
    turn, origin = _to_level(estimate.map_T_base[:, :3, 2].mean(axis=0)), estimate.map_T_base[0, :3, 3]

    def placed(points: Any) -> Floats:
        return np.asarray((points - origin) @ turn.T + origin)

    def posed(poses: Floats) -> Floats:
        turned = poses.copy()
        turned[:, :3, :3], turned[:, :3, 3] = turn @ poses[:, :3, :3], placed(poses[:, :3, 3])
        return turned

    def spread(covariance: Floats) -> Floats:
        turned = turn @ covariance @ turn.T
        return (turned + turned.swapaxes(-1, -2)) / 2

    more, correlated, held = estimate.error_covariance, estimate.correlated, estimate.moved_by_held
    tags = {
        j: replace(
            tag,
            xyzw=quaternion_from_rotation((turn @ tag.rotation)[None])[0],
            other_xyzw=None if tag.other is None else quaternion_from_rotation((turn @ tag.other)[None])[0],
        )
        for j, tag in estimate.tags.items()
    }
    found = replace(
        estimate,
        map_T_base=posed(estimate.map_T_base),
        positions=placed(estimate.positions),
        covariance=spread(estimate.covariance),
        error_covariance=None if more is None else spread(more),
        correlated=None if correlated is None else turn @ correlated,
        moved_by_held=None if held is None else turn @ held,
        tags=tags,
    )
    trace = []
    for one in solution.trace:
        steps = tuple(
            replace(step, path=placed(step.path).astype(np.float32), positions=placed(step.positions).astype(np.float32))
            for step in one.iterations
        )
        trace.append(replace(one, iterations=steps, map_T_base=posed(one.map_T_base), positions=placed(one.positions)))
    return replace(solution, estimate=found, trace=tuple(trace))


def _to_level(up: Floats) -> Floats:
    """Return the least rotation (3, 3) that turns a direction (3,) upright."""
    axis = np.cross(up, (0.0, 0.0, 1.0))
    size = np.linalg.norm(axis)
    return rotation_from_vector(axis * (np.arctan2(size, up[2]) / max(size, 1e-12)))
