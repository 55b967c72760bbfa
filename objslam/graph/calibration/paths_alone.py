"""Compare the localisation with the odometry alone, before any ray has an object."""

import numpy as np

from objslam.core.calibration import CalibratedMeasurements
from objslam.core.noise import NoiseFactors
from objslam.core.types import Association
from objslam.errors import SolveError
from objslam.graph.assembly import Measurements
from objslam.graph.calibration.linearised_graph import Linearised
from objslam.graph.calibration.localization_noise import noise_of_localization, without_localization
from objslam.graph.multiframes import Multiframes


def noise_of_paths(errors: CalibratedMeasurements, theta: np.ndarray) -> NoiseFactors:
    """Return `errors.noise` with the noise of the localisation that agrees best with the odometry.

    theta: (P,) the shared errors. If the odometry does not determine the path, the noise stays as it is.
    """
    keyframes, rays, settings = errors.at(theta)
    measured = Measurements.of(keyframes, rays, settings, Multiframes.of(errors.keyframes))
    nothing = Association(np.full(len(rays), -1), np.zeros(0, dtype=np.int64))
    used = np.zeros(len(rays), dtype=bool)
    paths = Linearised(measured, nothing, measured.keyframes.map_T_camera, np.zeros((0, 3)), used)
    try:
        return noise_of_localization(without_localization(paths), errors, theta)
    except SolveError:
        return errors.noise
