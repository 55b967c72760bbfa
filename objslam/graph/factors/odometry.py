"""Compute the motions between keyframes that odometry measures, with their covariances and their factors."""

import gtsam
import numpy as np

from objslam.config import Settings
from objslam.core.arrays import Bools, Floats, Ints
from objslam.core.geometry import adjoint, inverse, is_planar
from objslam.core.ground.flattening import noise_of_ground
from objslam.core.types import Keyframes
from objslam.graph.variables import X0

UNKNOWN_TURN, UNKNOWN_WAY = 0.5, 2.0
"""The standard deviations (rad, m) of a motion without a measurement, as if somebody carried the robot a few steps. Larger
values tie the two keyframes less."""

JUMP = 4.74
"""The scale of Cauchy's loss, in standard deviations, for a motion that fiducials also measure. Visual odometry jumps when
it corrects itself: a jump of 0.27 m was seen at 0.9 m/s. 99.9 % of all Gaussian errors are below this value (chi-squared, 6
degrees of freedom). With a larger value, a jump bends the map more. A smaller value uses less of the odometry."""


def motions(
    keyframes: Keyframes, settings: Settings, on_plane: bool | None = None, pairs: tuple[Ints, Ints] | None = None
) -> tuple[Floats, Floats]:
    """Return the camera motions (M, 4, 4) between pairs of keyframes, and their covariances (M, 6, 6).

    A motion is E_prev^-1 * odo * E_next. E is base_T_camera, and odo is the motion of base. The covariance is Ad(E_next^-1)
    S Ad(E_next^-1)^T plus a floor for each keyframe, with the rotation first. S is in the base frame at the second keyframe.
    It is the covariance that the odometry accumulated between the two keyframes, plus the covariance of their interpolated
    poses. Rows where `Keyframes.measured` is false have no meaning. ValueError if the keyframes have no odometry.

    Args:
        on_plane: whether the path is planar. If it is None, the poses decide.
        pairs: (M,), (M,) the keyframes before and after each motion. None means all K-1 consecutive pairs.
    """
    odom_T_base, drift = keyframes.odom_T_base, keyframes.drift
    if odom_T_base is None or drift is None:
        raise ValueError("the keyframes have no odometry, which motions need")
    on_plane = _on_plane(keyframes, odom_T_base) if on_plane is None else on_plane
    odom_T_camera, every = odom_T_base @ keyframes.base_T_camera, np.arange(len(keyframes))
    before, after = (every[:-1], every[1:]) if pairs is None else pairs
    floor = motion_floor(keyframes.base_T_camera[after], settings, on_plane) * (after - before)[:, None, None]
    if on_plane and (tilt := noise_of_ground(settings)[0]):
        floor += _climb(keyframes, odom_T_base, before, after, tilt)
    gathered = drift[after] - drift[before]
    if keyframes.wander is not None:
        gathered += wander(keyframes, before, after)
    camera_T_odom = inverse(odom_T_camera)
    covariance = motion_covariance(gathered, adjoint(camera_T_odom[after]), floor)
    return camera_T_odom[before] @ odom_T_camera[after], covariance


def _climb(keyframes: Keyframes, odom_T_base: Floats, before: Ints, after: Ints, tilt: float) -> Floats:
    """Return the covariances (M, 6, 6) of motions of a base that moves up or down along its own axes, in the camera frame.

    A planar odometry does not say in which plane the robot moves. On a slope, a tilted base moves along its own axes. A base
    that tilts on its suspension does not move along its own axes. So a motion may leave the plane of the base by the angle
    `tilt`, rad.
    """
    way = np.linalg.norm(odom_T_base[after, :3, 3] - odom_T_base[before, :3, 3], axis=1)
    up = adjoint(inverse(keyframes.base_T_camera[after]))[:, :, 5] * (way * tilt)[:, None]
    return np.asarray(up[:, :, None] * up[:, None, :])


def wander(keyframes: Keyframes, before: Ints, after: Ints, walk: bool = False) -> Floats:
    """Return the covariances (M, 6, 6) that the interpolation between poses of the odometry adds to motions.

    Like `Keyframes.drift`, the covariances are in the frame of odom_T_base. If a motion is inside one step of the odometry,
    half of its noise is at each end of the motion.

    Args:
        before, after: (M,), (M,) the keyframes, with odometry.
        walk: whether the path inside a step is a free random walk, not fixed at the poses of the odometry. Otherwise it is a
            bridge (`frontend.odometry_bridge`).
    """
    if keyframes.step is None or keyframes.wander is None or keyframes.odom_T_base is None:
        return np.zeros((len(before), 6, 6))
    passed = np.floor(keyframes.step)
    share = (keyframes.step - passed)[:, None]
    apart = share[after] - share[before]
    if walk:
        first, last, inside = 1 - share[before], share[after], np.abs(apart)
    else:
        first, last, inside = (part * (1 - part) for part in (share[before], share[after], np.abs(apart)))
    same = (passed[before] == passed[after])[:, None]
    size = keyframes.wander
    half, from_base = size[after] * inside / 2, adjoint(keyframes.odom_T_base)
    found = np.zeros((len(before), 6, 6))
    for at, variance in (
        (before, np.where(same, half, size[before] * first)),
        (after, np.where(same, half, size[after] * last)),
    ):
        found += (from_base[at] * variance[:, None, :]) @ np.swapaxes(from_base[at], -1, -2)
    return found


def _on_plane(keyframes: Keyframes, odom_T_base: Floats) -> bool:
    """Return whether the odometry is planar. With a localisation, each stretch without a gap may have its own plane."""
    stretch = keyframes.stretch
    if stretch is None or not keyframes.localized_every:
        return is_planar(odom_T_base)
    parts = [odom_T_base[stretch == one] for one in np.unique(stretch[stretch >= 0])]
    return all(is_planar(part) or is_planar(inverse(part[:1]) @ part) for part in parts)


def motion_floor(base_T_camera: Floats, settings: Settings, on_plane: bool) -> Floats:
    """Return the floor (..., 6, 6) of the covariance of a motion in the frame of the camera at base_T_camera (..., 4, 4)."""
    return _in_camera(base_T_camera, settings.odometry.floor_yaw, settings.odometry.floor_xy, settings, on_plane)


def unknown_motion(base_T_camera: Floats, settings: Settings, on_plane: bool) -> Floats:
    """Return the covariance (..., 6, 6) of a motion without a measurement, in the frame of the camera."""
    return _in_camera(base_T_camera, UNKNOWN_TURN, UNKNOWN_WAY, settings, on_plane)


def _in_camera(base_T_camera: Floats, turn: float, way: float, settings: Settings, on_plane: bool) -> Floats:
    """Return the covariance, in the camera frame, of a base motion with standard deviations `turn` (rad) and `way` (m)."""
    tilt, z = (settings.planar.tilt, settings.planar.z) if on_plane else (turn, way)
    variance = np.array([tilt, tilt, turn, way, way, z]) ** 2
    to_camera = adjoint(inverse(base_T_camera))
    return np.asarray((to_camera * variance) @ np.swapaxes(to_camera, -1, -2))


def motion_covariance(gathered: Floats, camera_from_drift: Floats, floor: Floats) -> Floats:
    """Return the covariances (..., 6, 6) of motions, each in the frame of its last camera.

    gathered: (..., 6, 6) the drift between the two poses. camera_from_drift: (..., 6, 6) the adjoint that moves the drift
    into the frame of the last camera. floor: (..., 6, 6) the covariance to add.
    """
    covariance = camera_from_drift @ gathered @ np.swapaxes(camera_from_drift, -1, -2) + floor
    return np.asarray((covariance + np.swapaxes(covariance, -1, -2)) / 2)


def betweens(
    before: Ints, after: Ints, motion: Floats, covariance: Floats, robust: Bools | None = None
) -> list[gtsam.NonlinearFactor]:
    """Return between-factors for the camera motions (M, 4, 4) from X(before) (M,) to X(after) (M,).

    robust: (M,) whether a motion has Cauchy's loss with `JUMP`. None means that no motion has it.
    """
    loss = np.zeros(len(motion), dtype=bool) if robust is None else robust
    columns = (before.tolist(), after.tolist(), motion, covariance, loss.tolist())
    return [between(*row) for row in zip(*columns, strict=True)]


def between(before: int, after: int, motion: Floats, covariance: Floats, robust: bool = False) -> gtsam.NonlinearFactor:
    """Return the factor of a camera motion (4, 4) with covariance (6, 6) from X(before) to X(after)."""
    noise: gtsam.noiseModel.Base = gtsam.noiseModel.Gaussian.Covariance(covariance)
    if robust:
        noise = gtsam.noiseModel.Robust.Create(gtsam.noiseModel.mEstimator.Cauchy.Create(JUMP), noise)
    return gtsam.BetweenFactorPose3(X0 + before, X0 + after, gtsam.Pose3(motion), noise)
