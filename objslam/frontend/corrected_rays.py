"""Correct the keyframes and the rays of a log for many values of its shared errors at once.

A derivative needs the rays at two values of each error. Most of the values change only the mounts and the lenses of the
cameras. So one computation for all values takes far less time than one computation for each.
"""

from collections.abc import Callable, Mapping, Sequence
from functools import partial

import numpy as np

from objslam.core.arrays import Floats, Ints
from objslam.core.calibration import AXES, LENS
from objslam.core.rotation import rotation_from_vector
from objslam.core.trajectory import poses_near
from objslam.core.types import Keyframes, Log, Rays
from objslam.frontend.corrected_log import refocused
from objslam.frontend.localization.measured_poses import carried_by_odometry

PLACE = ("x", "y", "z")
"""The errors of a camera's place on the robot: moves along the axes of base."""


def corrected_poses(
    log: Log,
    keyframes: Keyframes,
    errors: Sequence[Mapping[str, float]],
    odometry_at: Callable[[Mapping[str, float], Floats], Floats],
    max_gap: float,
) -> tuple[Floats, Floats, Floats]:
    """Return the poses of K keyframes, corrected for clocks and odometry, for M values of the shared errors.

    errors: M mappings from the name of an error to its value. odometry_at: returns the poses of the corrected odometry at
    stamps. max_gap: s, the longest gap of a path that is bridged. Returns the stamps (M, K), s, at which the poses are
    taken, all within the time of the path, map_T_base (M, K, 4, 4), and base_T_camera (M, K, 4, 4), not yet corrected for
    the errors of mounts.
    """
    path, localization = log.robot_path, log.localization
    assert path is not None
    clocks = np.array([[error.get(f"{one.camera.name}.clock", 0.0) for one in log.cameras] for error in errors])
    known = np.clip(keyframes.stamps + clocks[:, keyframes.camera], path.stamps[0], path.stamps[-1])
    base_T_camera = np.repeat(keyframes.base_T_camera[None], len(errors), axis=0)
    for index, one in enumerate(log.cameras):
        if one.mount is not None:
            mine = keyframes.camera == index
            at = poses_near(one.mount, known[:, mine].ravel(), max_gap)
            base_T_camera[:, mine] = at.reshape(len(errors), -1, 4, 4)
    if localization is None:
        map_T_base = np.stack([odometry_at(error, stamps) for stamps, error in zip(known, errors, strict=True)])
        return known, map_T_base, base_T_camera
    map_T_base = poses_near(localization, known.ravel(), max_gap).reshape(*known.shape, 4, 4)
    if keyframes.localized_at is not None:
        # In a session, the odometry does not reach some keyframes. The odometry carries no pose to such a keyframe.
        reached = True if keyframes.stretch is None else keyframes.stretch >= 0
        localized_at = np.where(reached, keyframes.localized_at, np.nan)
        for at, stamps, error in zip(map_T_base, known, errors, strict=True):
            at[:] = carried_by_odometry(at, stamps, localized_at, localization, partial(odometry_at, error), max_gap)
    return known, map_T_base, base_T_camera


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
    camera of each keyframe, as an index into `names`. rays: not yet corrected. errors: M mappings from the name of an error
    to its value. An error that is absent is 0.
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
