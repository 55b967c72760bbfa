"""The residuals of the rays if the shared errors, for example clock offsets, are not corrected."""

import numpy as np

from objslam.core.arrays import Floats
from objslam.core.geometry import angles_off, interpolate, inverse
from objslam.core.trajectory import Trajectory
from objslam.frontend.shared_errors import SharedErrors
from objslam.mapping.solution import Solution


def uncorrected_residual(errors: SharedErrors, solution: Solution, path: Trajectory) -> Floats | None:
    """Return the angles (R,), rad, between the rays as measured and their objects, NaN without an object.

    A ray as measured has the shared errors at the mean of their prior. The objects and the solved path are the same, so the
    angles show what the correction improved. path: map_T_base at its full rate. None if no shared errors were estimated.
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
