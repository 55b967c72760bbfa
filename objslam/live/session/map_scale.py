"""Computes how much the unknown scale of a map from odometry adds to the covariances of a snapshot."""

import numpy as np

from objslam.core.arrays import Floats
from objslam.graph.maps.live_prior_map import map_T_graph
from objslam.live.mapper.state import MapState

_SCALE = "odometry.scale"  # The name of this error among the shared errors.


def scale_sigma(m: MapState) -> float:
    """Return the standard deviation of the scale of the map, as a share. It is 0 if the scale is known, or not estimated.

    If the odometry's metre is too long or too short, so are all distances of the map. The graph takes this metre as exact.
    With a localisation or a prior map, the metre is known. Otherwise, the calibration that last corrected the map gives the
    uncertainty of the metre, or the calibration file does. Without either, the priors of the odometry and of the ranges give
    it.
    """
    if m.keyframes.localized.any() or map_T_graph(m.graph) is not None:
        return 0.0
    if m.calibration is not None and _SCALE in m.calibration.names:
        return float(m.calibration.sigma[m.calibration.names.index(_SCALE)])
    prior = m.given.calibration
    if prior.use is False or prior.scale == 0:
        return 0.0
    by_ranges = prior.range_scale if np.isfinite(m.rays.range).any() else np.inf
    return 1 / float(np.hypot(1 / prior.scale, 1 / max(by_ranges, 1e-9)))


def scale_covariances(m: MapState, positions: Floats) -> Floats:
    """Return the covariances (N, 3, 3), m^2, that the scale of the map adds to positions (N, 3), m, of a session.

    With another scale, the distances of all things from the start, where the map's frame begins, change by the same share.
    """
    sigma = scale_sigma(m)
    if sigma == 0 or not len(m.keyframes.id):
        return np.zeros((len(positions), 3, 3))
    first = m.graph.poses(m.keyframes.id[[int(m.keyframes.stamp.argmin())]])[0, :3, 3]
    away = sigma * (positions - first)
    return np.asarray(away[:, :, None] * away[:, None, :])
