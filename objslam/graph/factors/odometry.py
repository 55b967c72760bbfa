"""What the odometry says: the motion between two keyframes, and how little is known where it says nothing."""

from __future__ import annotations

import gtsam
import numpy as np

from objslam.config import Settings
from objslam.core.arrays import Bools, Floats
from objslam.core.geometry import adjoint, inverse, is_planar
from objslam.core.types import Keyframes
from objslam.graph.variables import X0

UNKNOWN_TURN, UNKNOWN_WAY = 0.5, 2.0
"""The standard deviations (rad, m) of a motion that nothing measured. Chosen for a robot that is carried a few steps; larger
ties the two keyframes less."""


def motions(keyframes: Keyframes, settings: Settings, on_plane: bool | None = None) -> tuple[Floats, Floats]:
    """Camera motion (K-1, 4, 4) between consecutive keyframes by odometry, and its covariance (K-1, 6, 6), rotation first.

    The measured motion is E_prev^-1 * odo * E_next and its covariance Ad(E_next^-1) S Ad(E_next^-1)^T, where S, in base, is
    what the odometry gathered between the two, and a floor for each step. on_plane: whether the path is planar, None to see.
    What is not `Keyframes.measured` has no meaning.
    """
    odom_T_base, drift = keyframes.odom_T_base, keyframes.drift
    if odom_T_base is None or drift is None:
        raise ValueError("motions need odometry")
    on_plane = _on_plane(keyframes, odom_T_base) if on_plane is None else on_plane
    odom_T_camera = odom_T_base @ keyframes.base_T_camera
    floor = motion_floor(keyframes.base_T_camera[1:], settings, on_plane)
    covariance = motion_covariance(drift[1:] - drift[:-1], adjoint(inverse(odom_T_camera[1:])), floor)
    return inverse(odom_T_camera[:-1]) @ odom_T_camera[1:], covariance


def _on_plane(keyframes: Keyframes, odom_T_base: Floats) -> bool:
    """Whether the odometry is planar; each stretch by itself, where the localisation says how they lie to each other."""
    stretch = keyframes.stretch
    if stretch is None or not keyframes.localized_every:
        return is_planar(odom_T_base)
    parts = [odom_T_base[stretch == one] for one in np.unique(stretch[stretch >= 0])]
    return all(is_planar(part) or is_planar(inverse(part[:1]) @ part) for part in parts)


def motion_floor(base_T_camera: Floats, settings: Settings, on_plane: bool) -> Floats:
    """The least covariance (..., 6, 6) of a motion to a camera that sits there (..., 4, 4), in its frame."""
    return _in_camera(base_T_camera, settings.odometry.floor_yaw, settings.odometry.floor_xy, settings, on_plane)


def unknown_motion(base_T_camera: Floats, settings: Settings, on_plane: bool) -> Floats:
    """The covariance (..., 6, 6) of a motion that nothing measured, in the frame of a camera at (..., 4, 4)."""
    return _in_camera(base_T_camera, UNKNOWN_TURN, UNKNOWN_WAY, settings, on_plane)


def _in_camera(base_T_camera: Floats, turn: float, way: float, settings: Settings, on_plane: bool) -> Floats:
    """The covariance (..., 6, 6), in the camera, of a motion of base that is known to `turn` (rad) and `way` (m)."""
    tilt, z = (settings.planar.tilt, settings.planar.z) if on_plane else (turn, way)
    variance = np.array([tilt, tilt, turn, way, way, z]) ** 2
    to_camera = adjoint(inverse(base_T_camera))
    return np.asarray((to_camera * variance) @ np.swapaxes(to_camera, -1, -2))


def motion_covariance(gathered: Floats, camera_from_drift: Floats, floor: Floats) -> Floats:
    """Covariances (..., 6, 6) of motions in the frames that they lead to, by what drift (..., 6, 6) was gathered on the way.

    camera_from_drift: (..., 6, 6) takes that to these frames.
    """
    covariance = camera_from_drift @ gathered @ np.swapaxes(camera_from_drift, -1, -2) + floor
    return np.asarray((covariance + np.swapaxes(covariance, -1, -2)) / 2)


def betweens(motion: Floats, covariance: Floats, first: int, measured: Bools | None = None) -> list[gtsam.NonlinearFactor]:
    """Between-factors for camera motions (M, 4, 4) from X(first), X(first + 1), ... each to the next.

    measured: (M,) which of them there are; None for all.
    """
    steps = np.arange(len(motion)) if measured is None else np.flatnonzero(measured)
    return [between(first + i, first + i + 1, motion[i], covariance[i]) for i in steps.tolist()]


def between(before: int, after: int, motion: Floats, covariance: Floats) -> gtsam.NonlinearFactor:
    """The between-factor of the camera motion (4, 4) with covariance (6, 6) from X(before) to X(after)."""
    noise = gtsam.noiseModel.Gaussian.Covariance(covariance)
    return gtsam.BetweenFactorPose3(X0 + before, X0 + after, gtsam.Pose3(motion), noise)
