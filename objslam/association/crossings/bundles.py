"""Divide the rays of each landmark into two bundles, at the widest gap between their directions."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from objslam.association.crossings.usual_views import UsualViews
from objslam.association.landmarks import State
from objslam.association.observations import MIN_DEPTH
from objslam.association.refinement import squared_offsets, variance
from objslam.core.arrays import Bools, Floats, Ints
from objslam.core.statistics import STRAY_RAY, grouped_median, grouped_sums

COUNTED = 10
"""The most boxes of a bundle that count as independent measurements of how boxes grow as the robot comes nearer. `existence`
has the same limit. A larger number trusts growing boxes more."""
TIGHTNESS = 0.1
"""The standard deviation of ln size within a bundle, after the distance is accounted for. A detector's boxes are less tight
around small things. A larger value trusts growing boxes less."""


@dataclass(frozen=True)
class Bundles:
    """G = 2 S bundles of S landmarks. The bundles of landmark i are 2 i and 2 i + 1.

    ray, group: (P,) the rays, and the bundle of each. landmark: (G,) the landmark of each bundle. noise: (G,) the factor on
    the noise of its rays. counted: (G,) how many of its boxes count as independent.
    """

    usual: UsualViews
    ray: Ints
    group: Ints
    landmark: Ints
    noise: Floats
    counted: Ints

    def take(self, which: Ints) -> Bundles:
        """Return the bundles with the ascending indices `which`, and their rays."""
        number = np.full(self.count, -1)
        number[which] = np.arange(len(which))
        mine = number[self.group] >= 0
        each = (self.landmark[which], self.noise[which], self.counted[which])
        return Bundles(self.usual, self.ray[mine], number[self.group[mine]], *each)

    @property
    def state(self) -> State:
        return self.usual.state

    @property
    def count(self) -> int:
        return len(self.landmark)

    def bearing_cost(self, position: Floats) -> Floats:
        """Return the sum (G,) of the squared deviations of the rays of each bundle from a point (G, 3) m."""
        off2, away = squared_offsets(self.state.obs, position[self.group], self.ray)
        squared = off2 / variance(self.state.obs, away, self.noise[self.group], self.ray)
        return np.asarray(np.bincount(self.group, np.minimum(squared, STRAY_RAY), self.count), dtype=float)

    def distance(self, position: Floats) -> Floats:
        """Return the median distance (G,) m of each bundle's cameras from a point (G, 3) m."""
        away = np.linalg.norm(position[self.group] - self.state.obs.origin[self.ray], axis=1)
        return grouped_median(away, self.group, self.count)

    def size(self, position: Floats) -> tuple[Floats, Floats]:
        """Return the size of the thing in each bundle if it is at a point (G, 3) m, and how well the boxes fit one size.

        The first value is the median ln size (G,), NaN for boxes without sizes. The second is the log likelihood (G,), up to
        a constant, that the boxes grow with nearness as the boxes of one thing do. It assumes a normal distribution of
        unknown variance.
        """
        away = np.linalg.norm(position[self.group] - self.state.obs.origin[self.ray], axis=1)
        ln_size = self.usual.ln_size[self.ray] + np.log(np.maximum(away, MIN_DEPTH))
        told = np.isfinite(ln_size)
        group, ln_size = self.group[told], ln_size[told]
        number = np.maximum(np.bincount(group, minlength=self.count), 1)
        mean = np.bincount(group, ln_size, self.count) / number
        scatter2 = np.bincount(group, (ln_size - mean[group]) ** 2, self.count) / number + TIGHTNESS**2
        growth = -0.5 * self.counted * np.log(scatter2)
        return grouped_median(ln_size, group, self.count), np.asarray(growth, dtype=float)


def second_bundle(
    direction: Floats, owner: Ints, count: int, least: float, used: Bools | None = None, fewest: int = 1
) -> Bools:
    """Return which rays (R,) are beyond the widest gap between the directions of their object's rays.

    The gap is searched along the line on which the directions spread most. For an object without a gap, no ray is beyond.

    Args:
        direction: (R, 3) unit, of the rays in map.
        owner: (R,) the object of each ray.
        count: the number of objects.
        least: rad, the least gap.
        used: (R,) the rays among which the gap is searched, all by default. The others go with the bundle on their side.
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
