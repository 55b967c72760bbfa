"""Factors from arrays: the geometry is vectorised first, so that only the construction itself is left to Python.

Keys: X(k) is keyframe k's camera in map (Pose3), L(j) is object j (Point3).
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache

import gtsam
import numpy as np

from objslam.config import Loss, Settings
from objslam.geometry import adjoint, inverse, is_planar, make_pose
from objslam.types import Floats, Ints, Keyframes

X0 = gtsam.symbol("x", 0)
L0 = gtsam.symbol("l", 0)

# Far enough that perspective is gone (relative error range / D), near enough that D * 1e-16 is still a nanometre.
STANDOFF = 1e7
_ORTHOGRAPHIC = gtsam.Cal3DS2(STANDOFF, STANDOFF, 0, 0, 0, 0, 0, 0, 0)
_CENTRE = np.zeros(2)

L1_METRES = 1e-6
"""Eq. 1's norm is Huber with a kink this small (m): below it the distance is squared."""
HUBER_K = 1.345
CAUCHY_K = 2.385
"""Standard deviations: each keeps 95 % efficiency on Gaussian noise (Huber 1981; Holland & Welsch 1977)."""


def x_key(keyframe: int) -> int:
    """The key of X(keyframe)."""
    return X0 + int(keyframe)


def l_key(landmark: int) -> int:
    """The key of L(landmark)."""
    return L0 + int(landmark)


def robust(loss: Loss, sigmas: Floats, dimension: int, l1_kink: float = L1_METRES) -> list[gtsam.noiseModel.Base]:
    """Noise models, one for each of the sigmas (R,), shared where they agree to three digits.

    The loss acts on the norm of the whitened residual. `l1` is a Huber that costs 1 for each sigma, with its kink at l1_kink
    (in the residual's unit). `gnc` is left without a loss: its optimiser brings it.
    """
    digits = 10.0 ** (np.floor(np.log10(sigmas)) - 2)
    return [_model(loss, sigma, dimension, l1_kink) for sigma in (np.round(sigmas / digits) * digits).tolist()]


@lru_cache(maxsize=4096)
def _model(loss: Loss, sigma: float, dimension: int, l1_kink: float) -> gtsam.noiseModel.Base:
    estimators, wrap = gtsam.noiseModel.mEstimator, gtsam.noiseModel.Robust.Create
    if loss == "l1":  # whitened by s, Huber's slope is k / s and its kink k * s: these are 1 / sigma and l1_kink
        whitened = gtsam.noiseModel.Isotropic.Sigma(dimension, np.sqrt(sigma * l1_kink))
        return wrap(estimators.Huber.Create(np.sqrt(l1_kink / sigma)), whitened)
    model = gtsam.noiseModel.Isotropic.Sigma(dimension, sigma)
    if loss == "huber":
        return wrap(estimators.Huber.Create(HUBER_K), model)
    if loss == "cauchy":
        return wrap(estimators.Cauchy.Create(CAUCHY_K), model)
    return model


def virtual_cameras(origins: Floats, directions: Floats) -> list[gtsam.Pose3]:
    """For each ray (R, 3), (R, 3) a far camera that looks along it: its image is the offset across the ray, in metres."""
    n = directions / np.linalg.norm(directions, axis=1, keepdims=True)
    helper = np.where(np.abs(n[:, :1]) < 0.7, [[1.0, 0.0, 0.0]], [[0.0, 1.0, 0.0]])
    x = np.cross(helper, n)
    x /= np.linalg.norm(x, axis=1, keepdims=True)
    poses = make_pose(np.stack([x, np.cross(n, x), n], axis=2), origins - STANDOFF * n)
    return [gtsam.Pose3(pose) for pose in poses]


def point_to_line_fixed(
    origins: Floats, directions: Floats, landmark: Ints, noise: Sequence[gtsam.noiseModel.Base]
) -> list[gtsam.NonlinearFactor]:
    """Eq. 1 with known poses: the residual's norm is the distance (m) of L(landmark) to the ray in map."""
    make, camera = gtsam.TriangulationFactorCal3DS2, gtsam.PinholeCameraCal3DS2
    return [
        make(camera(pose, _ORTHOGRAPHIC), _CENTRE, model, L0 + j)
        for pose, model, j in zip(virtual_cameras(origins, directions), noise, landmark.tolist(), strict=True)
    ]


def point_to_line(
    keyframe: Ints, directions: Floats, landmark: Ints, noise: Sequence[gtsam.noiseModel.Base]
) -> list[gtsam.NonlinearFactor]:
    """Eq. 1 with the pose as a variable: directions (R, 3) in the camera frame, residual in metres."""
    make, bodies = gtsam.GenericProjectionFactorCal3DS2, virtual_cameras(np.zeros_like(directions), directions)
    return [
        make(_CENTRE, model, X0 + k, L0 + j, _ORTHOGRAPHIC, False, False, body)
        for body, model, k, j in zip(bodies, noise, keyframe.tolist(), landmark.tolist(), strict=True)
    ]


def bearing(
    keyframe: Ints, directions: Floats, landmark: Ints, noise: Sequence[gtsam.noiseModel.Base]
) -> list[gtsam.NonlinearFactor]:
    """The angle off the ray (rad): directions (R, 3) in the camera frame."""
    make, unit = gtsam.BearingFactor3D, gtsam.Unit3
    return [
        make(X0 + k, L0 + j, unit(direction), model)
        for direction, model, k, j in zip(directions, noise, keyframe.tolist(), landmark.tolist(), strict=True)
    ]


def ranges(
    keyframe: Ints, measured: Floats, landmark: Ints, noise: Sequence[gtsam.noiseModel.Base]
) -> list[gtsam.NonlinearFactor]:
    """The distance (m) of L(landmark) from X(keyframe)."""
    return [
        gtsam.RangeFactor3D(X0 + k, L0 + j, r, model)
        for k, j, r, model in zip(keyframe.tolist(), landmark.tolist(), measured.tolist(), noise, strict=True)
    ]


def along_ray(
    origins: Floats, directions: Floats, measured: Floats, sigmas: Floats, landmark: Ints
) -> list[gtsam.NonlinearFactor]:
    """The distance along a ray in map with known poses: it says nothing across the ray, hence one row of information."""
    points = origins + directions * measured[:, None]
    roots = np.zeros((len(points), 3, 3))
    roots[:, 0] = directions / sigmas[:, None]
    loss = gtsam.noiseModel.mEstimator.Huber.Create(HUBER_K)
    make = gtsam.noiseModel.Gaussian.SqrtInformation
    return [
        gtsam.PriorFactorPoint3(L0 + j, point, gtsam.noiseModel.Robust.Create(loss, make(root)))
        for j, point, root in zip(landmark.tolist(), points, roots, strict=True)
    ]


def motions(keyframes: Keyframes, settings: Settings, on_plane: bool | None = None) -> tuple[Floats, Floats]:
    """Camera motion (K-1, 4, 4) between consecutive keyframes by odometry, and its covariance (K-1, 6, 6), rotation first.

    The measured motion is E_prev^-1 * odo * E_next and its covariance Ad(E_next^-1) S Ad(E_next^-1)^T, where S, in base, is
    what the odometry gathered between the two, and a floor for each step. on_plane: whether the path is planar, None to see.
    """
    odom_T_base, drift = keyframes.odom_T_base, keyframes.drift
    if odom_T_base is None or drift is None:
        raise ValueError("motions need odometry")
    on_plane = is_planar(odom_T_base) if on_plane is None else on_plane
    odom_T_camera = odom_T_base @ keyframes.base_T_camera
    floor = motion_floor(keyframes.base_T_camera[1:], settings, on_plane)
    covariance = motion_covariance(drift[1:] - drift[:-1], adjoint(inverse(odom_T_camera[1:])), floor)
    return inverse(odom_T_camera[:-1]) @ odom_T_camera[1:], covariance


def motion_floor(base_T_camera: Floats, settings: Settings, on_plane: bool) -> Floats:
    """The least covariance (..., 6, 6) of a motion to a camera that sits there (..., 4, 4), in its frame."""
    odometry, planar = settings.odometry, settings.planar
    tilt, z = (planar.tilt, planar.z) if on_plane else (odometry.floor_yaw, odometry.floor_xy)
    floor = np.array([tilt, tilt, odometry.floor_yaw, odometry.floor_xy, odometry.floor_xy, z]) ** 2
    to_camera = adjoint(inverse(base_T_camera))
    return np.asarray((to_camera * floor) @ np.swapaxes(to_camera, -1, -2))


def motion_covariance(gathered: Floats, camera_from_drift: Floats, floor: Floats) -> Floats:
    """Covariances (..., 6, 6) of motions in the frames that they lead to, by what drift (..., 6, 6) was gathered on the way.

    camera_from_drift: (..., 6, 6) takes that to these frames.
    """
    covariance = camera_from_drift @ gathered @ np.swapaxes(camera_from_drift, -1, -2) + floor
    return np.asarray((covariance + np.swapaxes(covariance, -1, -2)) / 2)


def betweens(motion: Floats, covariance: Floats, first: int) -> list[gtsam.NonlinearFactor]:
    """Between-factors for camera motions (M, 4, 4) from X(first), X(first + 1), ... each to the next."""
    return [between(first + i, first + i + 1, pose, s) for i, (pose, s) in enumerate(zip(motion, covariance, strict=True))]


def between(before: int, after: int, motion: Floats, covariance: Floats) -> gtsam.NonlinearFactor:
    """The between-factor of the camera motion (4, 4) with covariance (6, 6) from X(before) to X(after)."""
    noise = gtsam.noiseModel.Gaussian.Covariance(covariance)
    return gtsam.BetweenFactorPose3(x_key(before), x_key(after), gtsam.Pose3(motion), noise)


def localizations(
    keyframes: Keyframes, settings: Settings, first: int = 0, on_plane: bool | None = None
) -> list[gtsam.NonlinearFactor]:
    """Absolute pose priors on every keyframe, X(first) and on, with Huber's loss, for a localisation may jump.

    Keyframes that share a measurement share its information. on_plane: whether the path is planar, None to see.
    """
    of, planar = settings.localization, settings.planar
    on_plane = is_planar(keyframes.map_T_base) if on_plane is None else on_plane
    tilt, z = (planar.tilt, planar.z) if on_plane else (of.yaw, of.xy)
    s = np.diag([tilt, tilt, of.yaw, of.xy, of.xy, z]) ** 2 * keyframes.localized_every
    to_camera = adjoint(inverse(keyframes.base_T_camera))
    covariance = to_camera @ s @ np.swapaxes(to_camera, 1, 2)
    covariance = (covariance + np.swapaxes(covariance, 1, 2)) / 2
    loss = gtsam.noiseModel.mEstimator.Huber.Create(HUBER_K)
    noise = gtsam.noiseModel
    return [
        gtsam.PriorFactorPose3(x_key(first + k), gtsam.Pose3(pose), noise.Robust.Create(loss, noise.Gaussian.Covariance(c)))
        for k, (pose, c) in enumerate(zip(keyframes.map_T_camera, covariance, strict=True))
    ]
