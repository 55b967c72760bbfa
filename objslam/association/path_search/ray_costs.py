"""Compute the cost of the rays of each stretch of a path, in each state of the stretch."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Self

import numpy as np

from objslam.association.path_search.state_grid import STRETCH, Cells, Grid
from objslam.core.arrays import Bools, Floats, Ints
from objslam.core.geometry import lift_se2
from objslam.core.statistics import STRAY_RAY
from objslam.core.types import Rays

_LANDMARK_SIGMA = 0.03
"""The assumed standard deviation (m) of a landmark's position. A larger value accepts rays farther from landmarks."""
_NEAR = 4.0
"""The number of standard deviations beyond the grid up to which a landmark counts for a ray. At 4, a match costs more than a
stray ray. A larger value takes longer."""
_RAYS_AT_ONCE = 2000
"""The approximate number of rays that are compared with the map together. A larger number needs more memory."""


@dataclass(frozen=True)
class MapLandmarks:
    """N landmarks: position (N, 3) m, label (N,), and rarity (N,), the cost of a match in addition to the deviation."""

    position: Floats
    label: Ints
    rarity: Floats

    def take(self, some: Bools) -> Self:
        """Return the landmarks of a mask (N,)."""
        return replace(self, position=self.position[some], label=self.label[some], rarity=self.rarity[some])


@dataclass(frozen=True)
class Sight:
    """R rays at the present path, with origins and directions (R, 3) in map, and the stretch (R,) of each. pivot: (G, 3) m,
    the point about which each stretch turns."""

    rays: Rays
    origin: Floats
    direction: Floats
    stretch: Ints
    pivot: Floats
    grid: Grid

    def costs(self, landmarks: MapLandmarks) -> Iterator[Cells]:
        """Return for each stretch the cost (Y, X, X) of its rays in each state, in squared deviations."""
        from scipy.sparse import csr_array

        order, across = np.argsort(self.stretch, kind="stable"), len(self.grid.shifts)
        bounds = np.searchsorted(self.stretch[order], np.arange(len(self.pivot) + 1))
        begin = 0
        while begin < len(self.pivot):
            end = max(begin + 1, int(np.searchsorted(bounds, bounds[begin] + _RAYS_AT_ONCE, side="right")) - 1)
            some = order[bounds[begin] : bounds[end]]
            total = np.zeros((end - begin, len(self.grid.turns), across * across), dtype=np.float32)
            ones, rows = np.ones(len(some), dtype=np.float32), self.stretch[some] - begin
            summing = csr_array((ones, (rows, np.arange(len(some)))), shape=(end - begin, len(some)))
            for i, turn in enumerate(self.grid.turns.tolist()):
                total[:, i] = summing @ self._ray_costs(some, turn, landmarks)
            yield from total.reshape(end - begin, -1, across, across)
            begin = end

    def of_stretches(self, which: Bools) -> Self:
        """Return the rays of some stretches (G,) alone."""
        mine = which[self.stretch]
        stretch, pivot = (np.cumsum(which) - 1)[self.stretch[mine]], self.pivot[which]
        origin, direction = self.origin[mine], self.direction[mine]
        return replace(self, rays=self.rays.take(mine), origin=origin, direction=direction, stretch=stretch, pivot=pivot)

    def _ray_costs(self, some: Ints, turn: float, landmarks: MapLandmarks) -> Cells:
        """Return the cost (n, X * X) of rays (n,) for each shift after a turn. A ray costs at most `STRAY_RAY`."""
        rays, pivot = self.rays.take(some), self.pivot[self.stretch[some]]
        turned = lift_se2(np.array([0.0, 0.0, turn]))[:3, :3].T
        n, origin = self.direction[some] @ turned, pivot + (self.origin[some] - pivot) @ turned
        ranged = np.isfinite(rays.range)
        reach, rounded = np.sqrt(2) * self.grid.shifts[-1], _LANDMARK_SIGMA**2 + self.grid.shift**2 / 12
        angle = rays.sigma**2 + (STRETCH * self.grid.turn / 2) ** 2 + self.grid.turn**2 / 12
        noise = rays.range_sigma**2 + np.nan_to_num(rays.range_bias) ** 2 + rounded
        to = landmarks.position - origin[:, None]
        along = np.einsum("rnk,rk->rn", to, n)
        distance2 = np.einsum("rnk,rnk->rn", to, to)
        spread = angle[:, None] * distance2 + rounded
        near = (along > 0) & (rays.label[:, None] == landmarks.label)
        near &= distance2 - along**2 < (reach + _NEAR * np.sqrt(spread)) ** 2
        beyond = along - np.where(ranged, rays.range, 0.0)[:, None]
        near &= ~ranged[:, None] | (np.abs(beyond) < reach + _NEAR * np.sqrt(noise)[:, None])
        i, j = np.nonzero(near)
        # The cost is quadratic in the shift. A range measures along the ray, the bearing measures across it.
        by_range, by_bearing = np.where(ranged, 1 / noise, 0.0)[i], 1 / spread[i, j]
        n, over = n[i], beyond[i, j]
        off = to[i, j] - along[i, j, None] * n
        (x, y), more = n[:, :2].T, by_range - by_bearing
        quadratic = [by_bearing + more * x * x, 2 * more * x * y, by_bearing + more * y * y]
        linear = [-2 * (by_bearing * off[:, axis] + by_range * over * n[:, axis]) for axis in (0, 1)]
        constant = by_bearing * np.einsum("ei,ei->e", off, off) + by_range * over**2 + landmarks.rarity[j]
        shift_x, shift_y = (a.ravel() for a in np.meshgrid(self.grid.shifts, self.grid.shifts, indexing="ij"))
        powers = [shift_x**2, shift_x * shift_y, shift_y**2, shift_x, shift_y, np.ones_like(shift_x)]
        best = np.full((len(some), len(shift_x)), STRAY_RAY, dtype=np.float32)
        factors, table = (
            np.stack([*quadratic, *linear, constant], axis=1).astype(np.float32),
            np.stack(powers).astype(np.float32),
        )
        number = np.bincount(i, minlength=len(some))  # The landmarks of a ray follow one another.
        order, first = np.argsort(-number, kind="stable"), np.cumsum(number) - number
        for k in range(int(number.max(initial=0))):  # With the rays in this order, each step changes the first rows.
            rows = best[: np.count_nonzero(number > k)]
            np.minimum(rows, factors[first[order[: len(rows)]] + k] @ table, out=rows)
        return best[np.argsort(order)]
