"""Add what uneven ground hides to the heights of a map that was solved from planar poses.

Planar poses say that the robot stands at the height 0, on level ground. The ground between the robot and a thing still rises
or falls, in the same way for all rays of some seconds and at each visit. A solve of poses has a new tilt of the robot every
few moments, so its covariances say that many rays average this error out.
"""

from dataclasses import replace

import numpy as np

from objslam.config import Settings
from objslam.core.geometry import lift_se2, split_se2
from objslam.graph.fixed_pose_triangulation import noise_up
from objslam.mapping.fixed.lasting_errors import cells_of, rise_of_ground, with_covariances
from objslam.mapping.fixed.lasting_noise import lasting_variances
from objslam.mapping.solution import Solution


def with_unknown_heights(solution: Solution, settings: Settings) -> Solution:
    """Return the solution of a joint solve at localised planar poses on uneven ground, with larger covariances of heights.

    The rays miss their objects up and down at poses without tilt and height. These misses show how large the errors of the
    ground are, and how long they last, as at given poses (`with_lasting_errors`). The solution stays as it is if the poses
    are not planar, if there is no localisation, or if the ground is flat.
    """
    keyframes = solution.keyframes
    if not any(noise_up(keyframes, settings)):
        return solution
    place, offset = split_se2(solution.estimate.map_T_base)[0], split_se2(keyframes.map_T_base)[1]
    level = replace(keyframes, map_T_base=lift_se2(place) @ offset)
    seen = cells_of(replace(solution, keyframes=level), settings)
    if not seen:
        return solution
    variances = lasting_variances(seen[-1])
    objects, more = seen[-1].covariances(variances)
    added = np.zeros(solution.estimate.covariance.shape)
    added[objects, 2, 2] = more[:, 2, 2]
    added[:, 2, 2] += rise_of_ground(level, variances, settings) ** 2
    return with_covariances(solution, added)
