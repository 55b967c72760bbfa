"""How large objects are: from the sizes of their boxes and how far away they were."""

from __future__ import annotations

import numpy as np

from objslam.association.sightings import size_per_metre
from objslam.types import Association, Camera, Floats, Ints, Keyframes, Rays


def extents(
    rays: Rays,
    association: Association,
    positions: Floats,
    map_T_camera: Floats,
    keyframes: Keyframes,
    cameras: tuple[Camera, ...],
) -> Floats:
    """Width and height (N, 2), m, of the objects at positions (N, 3): the median over their rays.

    NaN where there is no ray, no position, or half of the rays are of a camera that sees no sizes.
    map_T_camera: (K, 4, 4) of the keyframes.
    """
    held = np.flatnonzero(association.object >= 0)
    index = association.object[held]
    distance = np.linalg.norm(positions[index] - map_T_camera[rays.keyframe[held], :3, 3], axis=1)
    size = size_per_metre(rays.take(held), keyframes, cameras) * distance[:, None]
    size[~np.array([c.sees_size for c in cameras])[keyframes.camera[rays.keyframe[held]]]] = np.nan
    return np.stack([grouped_median(column, index, association.count) for column in size.T], axis=1)


def grouped_median(values: Floats, index: Ints, count: int) -> Floats:
    """The (upper) median (N,) of the values (R,) of each group; index: (R,) group of each value; NaN where there is none."""
    return grouped_quantile(values, index, count, 0.5)


def grouped_quantile(values: Floats, index: Ints, count: int, share: float) -> Floats:
    """The value (N,) of each group with `share` of its values below; NaN where there is none."""
    order = np.lexsort((values, index))
    number = np.bincount(index, minlength=count)
    at = np.cumsum(number) - number + np.minimum((share * number).astype(np.int64), np.maximum(number - 1, 0))
    result = np.full(count, np.nan)
    some = number > 0
    result[some] = values[order][at[some]]
    return result
