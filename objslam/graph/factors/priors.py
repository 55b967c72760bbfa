"""Priors that no sensor measured: they say where the map lies, and keep the graph determined."""

from __future__ import annotations

import gtsam
import numpy as np

from objslam.config import Settings
from objslam.core.arrays import Floats, Ints
from objslam.graph.variables import L0, X0

ANCHOR = 1e-4
"""The standard deviation (rad, m) with which the first keyframe is held. Chosen far below any measurement's; larger lets the
map drift as a whole, smaller makes the linear system worse conditioned."""


def landmark_priors(landmarks: Ints, positions: Floats, settings: Settings) -> list[gtsam.NonlinearFactor]:
    """A weak prior on each of the landmarks (n,) at its place in positions (N, 3): it keeps the graph determined."""
    return [point_prior(j, positions[j], settings.joint.prior_sigma) for j in landmarks.tolist()]


def anchor(keyframe: int, map_T_camera: Floats) -> gtsam.NonlinearFactor:
    """Hold X(keyframe) where it is (4, 4): bearings and odometry alone do not say where the map lies."""
    return pose_prior(keyframe, map_T_camera, ANCHOR, ANCHOR)


def point_prior(landmark: int, position: Floats, sigma: float) -> gtsam.NonlinearFactor:
    """L(landmark) at a position (3,), to a standard deviation (m) along each axis."""
    return gtsam.PriorFactorPoint3(L0 + landmark, position, gtsam.noiseModel.Isotropic.Sigma(3, sigma))


def pose_prior(keyframe: int, map_T_camera: Floats, turn: float, way: float) -> gtsam.NonlinearFactor:
    """X(keyframe) at a pose (4, 4), to standard deviations of `turn` (rad) and `way` (m) along each axis."""
    noise = gtsam.noiseModel.Diagonal.Sigmas(np.array([turn] * 3 + [way] * 3))
    return gtsam.PriorFactorPose3(X0 + keyframe, gtsam.Pose3(map_T_camera), noise)
