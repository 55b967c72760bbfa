"""Compute the residuals that the rays have without the correction of shared errors, for example clock offsets."""

import numpy as np

from objslam.core.arrays import Floats
from objslam.core.geometry import angles_off, interpolate, inverse
from objslam.core.trajectory import Trajectory
from objslam.frontend.shared_errors import SharedErrors
from objslam.mapping.solution import Solution


def uncorrected_residual(errors: SharedErrors, solution: Solution, path: Trajectory) -> Floats | None:
    """Return the angles (R,) in rad between the rays as measured and their objects. An angle is NaN for a ray without an
    object. The result is None if no shared errors were estimated.

    A ray as measured has the shared errors at the mean of their prior. The objects and the solved path are the same as with
    the correction. So the angles show what the correction improved. path: the solved poses map_T_base, at the full rate of
    the path.
    """
    if solution.estimate.calibration is None:
        return None
    before, rays, _ = errors.at(errors.mean, drift=False)

    def along(stamps: Floats) -> Floats:
        return interpolate(path.stamps, path.poses, np.clip(stamps, path.stamps[0], path.stamps[-1]), np.inf)[0]

    motion = inverse(along(solution.keyframes.stamps)) @ along(before.stamps)
    origins, directions = rays.in_map(solution.estimate.map_T_base @ motion @ before.base_T_camera)
    owner = solution.association.object
    residual = np.full(len(rays), np.nan)
    held = owner >= 0
    residual[held] = angles_off(origins[held], directions[held], solution.estimate.positions[owner[held]])
    return residual
