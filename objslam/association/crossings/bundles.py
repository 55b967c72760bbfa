"""Divide the rays of each object into two bundles, at the widest gap between their directions."""

import numpy as np

from objslam.association.refinement import grouped_sums
from objslam.core.arrays import Bools, Floats, Ints


def second_bundle(
    direction: Floats, owner: Ints, count: int, least: float, used: Bools | None = None, fewest: int = 1
) -> Bools:
    """Return which rays (R,) are beyond the widest gap between the directions of their object's rays.

    The gap is searched along the line on which the directions spread most. An object without a gap has no such rays.

    Args:
        direction: (R, 3) unit, of the rays in map.
        owner: (R,) the object of each ray.
        count: the number of objects.
        least: rad, the least gap.
        used: (R,) the rays that tell the gap, all by default. The others go with the bundle on their side of it.
        fewest: the fewest used rays of a bundle.
    """
    mine = np.arange(len(owner)) if used is None else np.flatnonzero(used)
    of, number = owner[mine], np.bincount(owner[mine], minlength=count)
    mean = grouped_sums(direction[mine], of, count) / np.maximum(number, 1)[:, None]
    off = direction - mean[owner]
    scatter = grouped_sums((off[mine, :, None] * off[mine, None, :]).reshape(-1, 9), of, count).reshape(-1, 3, 3)
    axis = np.linalg.eigh(scatter)[1][:, :, -1]
    position = np.einsum("ri,ri->r", off, axis[owner])
    order = np.lexsort((position[mine], of))
    of, along = of[order], position[mine[order]]
    before = np.arange(len(of)) - (np.cumsum(number) - number)[of] + 1  # Rays of the object up to each one.
    gap = np.append(np.diff(along), 0.0)
    gap[(before < fewest) | (number[of] - before < fewest)] = 0.0
    widest = np.zeros(count)
    np.maximum.at(widest, of, gap)
    border = np.full(count, np.inf)
    at = np.flatnonzero((gap == widest[of]) & (gap >= least))
    border[of[at]] = along[at] + gap[at] / 2
    return np.asarray(position > border[owner])
