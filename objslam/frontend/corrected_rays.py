"""The rays of a log in map, corrected for many values of its shared errors at once.

A derivative needs the rays at two values of each error. Most of these values change only the mounts and the lenses of the
cameras. So one computation for all values takes far less time than one computation for each.
"""

from collections.abc import Mapping, Sequence

import numpy as np

from objslam.core.arrays import Floats, Ints
from objslam.core.rotation import rotation_from_vector
from objslam.core.types import Rays
from objslam.frontend.corrected_log import AXES, LENS, refocused

PLACE = ("x", "y", "z")
"""The moves of a camera on the robot, along the axes of base."""


def corrected_rays(
    map_T_base: Floats,
    base_T_camera: Floats,
    camera: Ints,
    rays: Rays,
    names: Sequence[str],
    errors: Sequence[Mapping[str, float]],
) -> tuple[Floats, Floats, Floats]:
    """Return origins (M, R, 3), m, and unit directions (M, R, 3) of rays in map, and their noise (M, R), rad.

    map_T_base, base_T_camera: (M, K, 4, 4) of each keyframe, not yet corrected for the errors of mounts. camera: (K,) the
    camera of each keyframe, as an index into `names`. rays: not yet corrected. errors: M values of the shared errors by
    name. An absent name is 0.
    """
    turn = rotation_from_vector(_of_cameras(errors, names, AXES))[:, camera]
    move = _of_cameras(errors, names, PLACE)[:, camera]
    lens = _of_cameras(errors, names, LENS)[:, camera[rays.keyframe]]
    turned = (map_T_base[..., :3, :3] @ turn @ base_T_camera[..., :3, :3])[:, rays.keyframe]
    places = np.einsum("mkij,mkj->mki", map_T_base[..., :3, :3], base_T_camera[..., :3, 3] + move) + map_T_base[..., :3, 3]
    origins = places[:, rays.keyframe]
    if rays.offset is not None:
        origins = origins + _rotated(turned, rays.offset)
    if not lens.any():
        return origins, _rotated(turned, rays.direction), np.broadcast_to(rays.sigma, lens.shape[:2])
    directions, factors = refocused(rays.direction, lens)
    return origins, _rotated(turned, directions), rays.sigma * factors


def _rotated(rotations: Floats, vectors: Floats) -> Floats:
    """Return the products (M, R, 3) of matrices (M, R, 3, 3) and vectors (R, 3) or (M, R, 3).

    `np.einsum` takes three to ten times as long, because the matrices of a ray lie side by side in memory."""
    x, y, z = (vectors[..., k, None] for k in range(3))
    return np.asarray(rotations[..., 0] * x + rotations[..., 1] * y + rotations[..., 2] * z)


def _of_cameras(errors: Sequence[Mapping[str, float]], cameras: Sequence[str], kinds: Sequence[str]) -> Floats:
    """Return the errors (M, C, k) of each camera."""
    return np.array([[[of.get(f"{name}.{one}", 0.0) for one in kinds] for name in cameras] for of in errors])
