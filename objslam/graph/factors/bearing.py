"""Factors for the bearing of a box: the angle between ray and object, or the distance of the object from the ray.

The distance is the one in Eq. 1 of Staszak & Belter.
"""

import gtsam
import numpy as np

from objslam.core.arrays import Floats, Ints
from objslam.core.geometry import lengths, make_pose
from objslam.core.rotation import cross
from objslam.graph.factors.noise import Noise
from objslam.graph.variables import L0, X0

STANDOFF = 1e7
"""The distance (m) of a virtual camera behind the origin of its ray. A larger value has a smaller error by perspective, and
a larger rounding error. The relative error by perspective is the range divided by this distance. The rounding error at this
distance is 1 nm."""
L1_RADIANS = 1e-4
"""The angle (rad) below which the loss `l1` on bearings is quadratic, so that it has a derivative at 0. A larger angle is
smoother and less like a norm. This angle is about a twentieth of a pixel, far below the noise of a box."""
EQ1_SIGMA = 0.05
"""The standard deviation (m) of the point-to-line distance in the joint solve. Eq. 1 has no noise model, so this value
weighs its distances against the odometry. A larger value trusts the odometry more."""
_ORTHOGRAPHIC = gtsam.Cal3DS2(STANDOFF, STANDOFF, 0, 0, 0, 0, 0, 0, 0)
_EQUIDISTANT = gtsam.Cal3Fisheye(1, 1, 0, 0, 0, 0, 0, 0, 0)
_CENTRE = np.zeros(2)


def bearings(
    keyframe: Ints, directions: Floats, landmark: Ints, noise: Noise, offset: Floats | None = None
) -> list[gtsam.NonlinearFactor]:
    """Return a factor for each ray on the angle (rad) between the ray and L(landmark).

    directions: (R, 3) in the frame of X(keyframe). offset: (R, 3) m, the origin of each ray in this frame. None means the
    origin of the frame. GTSAM has no bearing factor with an offset. So a ray with an offset gets an equidistant camera of
    focal length 1 px that looks along the ray. The distance of the landmark from the centre of its image is the angle.
    For a landmark behind the camera, the residual is larger and constant.
    """
    unit, away = gtsam.Unit3, np.zeros(len(directions), dtype=bool) if offset is None else (offset != 0).any(axis=1)
    cameras = iter(() if offset is None else _poses(offset[away], directions[away]))

    def make(k: int, j: int, direction: list[float], model: gtsam.noiseModel.Base, aside: bool) -> gtsam.NonlinearFactor:
        if not aside:
            return gtsam.BearingFactor3D(X0 + k, L0 + j, unit(*direction), model)  # An array takes half as long again.
        at = next(cameras)
        return gtsam.GenericProjectionFactorCal3Fisheye(_CENTRE, model, X0 + k, L0 + j, _EQUIDISTANT, False, False, at)

    columns = (keyframe.tolist(), landmark.tolist(), directions.tolist(), noise, away.tolist())
    return [make(*row) for row in zip(*columns, strict=True)]


def point_to_line(
    keyframe: Ints, directions: Floats, landmark: Ints, noise: Noise, offset: Floats | None = None
) -> list[gtsam.NonlinearFactor]:
    """Return a factor for each ray on the distance (m, Eq. 1) between the ray and L(landmark).

    directions: (R, 3) in the frame of X(keyframe). offset: (R, 3) m, the origin of each ray in this frame. None means the
    origin of the frame.
    """
    origins = np.zeros_like(directions) if offset is None else offset
    make, bodies = gtsam.GenericProjectionFactorCal3DS2, virtual_cameras(origins, directions)
    return [
        make(_CENTRE, model, X0 + k, L0 + j, _ORTHOGRAPHIC, False, False, body)
        for body, model, k, j in zip(bodies, noise, keyframe.tolist(), landmark.tolist(), strict=True)
    ]


def point_to_line_fixed(origins: Floats, directions: Floats, landmark: Ints, noise: Noise) -> list[gtsam.NonlinearFactor]:
    """Return a factor for each ray on the distance (m, Eq. 1) between the ray and L(landmark), for fixed poses.

    origins, directions: (R, 3) in map. The norm of the residual is the distance.
    """
    make, camera = gtsam.TriangulationFactorCal3DS2, gtsam.PinholeCameraCal3DS2
    return [
        make(camera(pose, _ORTHOGRAPHIC), _CENTRE, model, L0 + j)
        for pose, model, j in zip(virtual_cameras(origins, directions), noise, landmark.tolist(), strict=True)
    ]


def bearings_fixed(
    origins: Floats, directions: Floats, standoff: Floats, landmark: Ints, noise: Noise
) -> list[gtsam.NonlinearFactor]:
    """Return a factor for each ray on the angle (rad) between the ray and L(landmark), for fixed poses.

    The angle is seen from a point behind the origin of the ray. For a landmark behind this point, the residual is larger and
    constant.

    Args:
        origins, directions: (R, 3) m, (R, 3) in map.
        standoff: (R,) m, the distance of the point from the origin. With 0, the residual is the bearing. With a large
            standoff, the residual is the distance of Eq. 1 divided by the standoff.
    """
    make, camera = gtsam.TriangulationFactorCal3Fisheye, gtsam.PinholeCameraCal3Fisheye
    n = directions / np.linalg.norm(directions, axis=1, keepdims=True)
    return [
        make(camera(pose, _EQUIDISTANT), _CENTRE, model, L0 + j)
        for pose, model, j in zip(_poses(origins - standoff[:, None] * n, n), noise, landmark.tolist(), strict=True)
    ]


def virtual_cameras(origins: Floats, directions: Floats) -> list[gtsam.Pose3]:
    """Return a camera pose for each ray, `STANDOFF` behind its origin (R, 3) m. The camera looks along its direction (R, 3).

    The image coordinates of a point are the offset (m) of the point across the ray.
    """
    n = directions / np.linalg.norm(directions, axis=1, keepdims=True)
    return _poses(origins - STANDOFF * n, n)


def tangent_basis(directions: Floats) -> Floats:
    """Return two unit vectors (R, 3, 2) across unit directions (R, 3), as GTSAM chooses them (`Unit3::basis`).

    The first vector is the cross product of the direction and an axis: the axis along which the direction has its smallest
    component in absolute value.
    """
    first = cross(directions, np.eye(3)[np.argmin(np.abs(directions), axis=1)])
    first /= lengths(first)[:, None]
    return np.stack([first, cross(directions, first)], axis=2)


def residual_axes(directions: Floats, to_landmark: Floats, offset: Floats | None, metric: bool) -> Floats:
    """Return the axes (R, 3, 2) along which the factors of rays measure their residuals, for `ray_residuals`.

    In GTSAM's bearing factor (no offset, not metric), the axes are perpendicular to the line from the origin to the
    landmark. In all other factors, the axes are perpendicular to the ray. directions, to_landmark, offset: (R, 3).
    """
    if metric:
        return tangent_basis(directions)
    to = to_landmark / lengths(to_landmark)[:, None]
    return tangent_basis(to if offset is None else np.where((offset != 0).any(axis=1)[:, None], directions, to))


def ray_residuals(directions: Floats, to_landmark: Floats, axes: Floats, metric: bool) -> Floats:
    """Return the residuals (R, 2) of the factors of rays, along axes (R, 3, 2).

    directions: (R, 3) unit. to_landmark: (R, 3) m, from the origin of the ray, in the same frame. metric: whether residuals
    are distances from the ray (m, Eq. 1), or angles (rad). Below pi / 2, the angles agree with GTSAM's factors.
    """
    along = np.einsum("ri,ri->r", directions, to_landmark)
    across = to_landmark - along[:, None] * directions
    residuals = np.einsum("rij,ri->rj", axes, across)
    if not metric:
        angle = np.arctan2(lengths(across), along)
        residuals *= (angle / np.maximum(lengths(residuals), 1e-300))[:, None]
    return np.asarray(residuals)


def ray_jacobians(directions: Floats, to_landmark: Floats, axes: Floats, offset: Floats | None, metric: bool) -> Floats:
    """Return the derivatives (R, 2, 3) of `ray_residuals` by the position of the landmark, as GTSAM's factors compute them.

    The derivative of GTSAM's bearing factor leaves out terms that vanish with the residual.
    """
    across = np.swapaxes(axes, 1, 2)
    if metric:
        return across
    by_position = across / lengths(to_landmark)[:, None, None]
    away = np.zeros(len(directions), dtype=bool) if offset is None else (offset != 0).any(axis=1)
    if away.any():  # In the camera of `bearings`, the landmark has depth z, and distance r from the optical axis.
        flat = (across[away] @ to_landmark[away, :, None])[..., 0]
        r, z = np.linalg.norm(flat, axis=1), np.einsum("ri,ri->r", directions[away], to_landmark[away])
        outward = flat / np.maximum(r, 1e-300)[:, None]
        turning = (np.where(r > 1e-9 * np.abs(z), np.arctan2(r, z) / np.maximum(r, 1e-300), 1 / z))[:, None, None]
        radial = (z / (r**2 + z**2))[:, None, None]
        outer = outward[:, :, None] * outward[:, None, :]
        by_flat = turning * (np.eye(2) - outer) + radial * outer
        by_depth = -(r / (r**2 + z**2))[:, None] * outward
        by_position[away] = by_flat @ across[away] + by_depth[:, :, None] * directions[away, None, :]
    return np.asarray(by_position)


def _poses(origins: Floats, directions: Floats) -> list[gtsam.Pose3]:
    """Return a camera pose for each ray: at its origin (R, 3), m, looking along its unit direction (R, 3)."""
    axes = np.concatenate([tangent_basis(directions), directions[:, :, None]], axis=2)
    return [gtsam.Pose3(pose) for pose in make_pose(axes, origins)]
