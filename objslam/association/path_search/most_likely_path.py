"""Find the most likely path of a robot through a map of landmarks, when each ray may belong to any landmark.

A path that is bent onto wrong landmarks fits them well, so no small change improves it. This search is global: it tries to
move each stretch of the path from wrong landmarks to landmarks beside them. It is Markov localisation on a grid (Fox,
Burgard and Thrun 1999). The states of a short stretch of the path are planar corrections of the stretch. Each state is a
turn and a shift. The rays show how well a state fits the map. The odometry shows how well the states of two stretches fit
together. Dynamic programming finds the most likely states of all stretches (Viterbi 1967).
"""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Self

import numpy as np
from numpy.typing import NDArray

from objslam.association.path_search.ray_costs import MapLandmarks, Sight
from objslam.association.path_search.state_grid import Cells, Grid, stretches
from objslam.association.path_search.viterbi import Motions, most_likely_states
from objslam.core.arrays import Bools, Floats, Ints
from objslam.core.geometry import lift_se2
from objslam.core.trajectory import correct_poses
from objslam.core.types import Keyframes, Rays

_STEPS_APART = 4.0
"""The number of grid steps between neighbouring landmarks of one label. With a larger number, the grid is finer and reaches
less far. It reaches `_SHIFTS` / `_STEPS_APART` neighbours."""
_MOST_TURN = np.radians(1.0)
"""The largest grid step (rad) in yaw. The step of shifts is this turn at the median distance of landmarks. A larger value
finds larger errors of the path. The heading of a solved path errs by 14 degrees at most."""


@dataclass(frozen=True)
class LikelyPath:
    """The most likely path. map_T_base: (K, 4, 4) the poses. turn, shift: rad and m, rough standard deviations of the errors
    that the steps of the grid cause in the poses."""

    map_T_base: Floats
    turn: float
    shift: float

    @property
    def pose_covariance(self) -> Floats:
        """The covariance (6, 6) of each pose, rotation (rad) first, then position (m)."""
        return np.diag([self.turn**2] * 3 + [self.shift**2] * 3)


@dataclass(frozen=True)
class PathSearch:
    """A search for the most likely path through a map, and through the same map without one of its landmarks.

    Corrections are planar like the drift of wheels. They reach as far as a few neighbouring landmarks. A match with a
    landmark that is rarely detected costs more, so a second copy of a landmark loses its rays. A frame may give two rays to
    one landmark.

    keyframes: K, with odometry. map_T_base: (K, 4, 4) the present path. middle: (G,) the keyframe at the middle of each
    stretch. known: (n,) the landmarks with a position. sight: the rays. landmarks: these n landmarks.
    """

    keyframes: Keyframes
    map_T_base: Floats
    middle: Ints
    known: Ints
    sight: Sight
    landmarks: MapLandmarks

    @classmethod
    def of(
        cls, keyframes: Keyframes, rays: Rays, map_T_base: Floats, positions: Floats, label: Ints, rate: Floats
    ) -> Self | None:
        """Prepare a search. Return None without rays, and if no label has two landmarks that could be confused.

        positions, label: (N, 3) m and (N,) of the landmarks, NaN without a position. rate: (N,) the share of the frames in
        view of each landmark that detect it.
        """
        from scipy.spatial import cKDTree

        known = np.flatnonzero(np.isfinite(positions[:, 0]) & (rate > 0))
        spacing = _spacing(positions[known], label[known])
        if not len(rays) or not np.isfinite(spacing):
            return None
        origin, direction = rays.in_map(map_T_base @ keyframes.base_T_camera)
        nearest, _ = cKDTree(positions[known]).query(origin)  # All distances at once would take too much memory.
        distance = float(np.median(np.where(np.isfinite(rays.range), rays.range, nearest)))
        turn = min(max(spacing / _STEPS_APART / distance, float(np.median(rays.sigma))), _MOST_TURN)
        grid = Grid(turn * distance, turn)
        stretch = stretches(keyframes, grid)
        bounds = np.searchsorted(stretch, np.arange(stretch[-1] + 2))
        middle = (bounds[:-1] + bounds[1:] - 1) // 2
        sight = Sight(rays, origin, direction, stretch[rays.keyframe], map_T_base[middle, :3, 3], grid)
        landmarks = MapLandmarks(positions[known], label[known], -2 * np.log(rate[known] / rate[known].max()))
        return cls(keyframes, map_T_base, middle, known, sight, landmarks)

    def path(self) -> LikelyPath:
        """Return the most likely path through the map."""
        return self._along(self.sight.costs(self.landmarks))

    def path_without(self, landmark: int, rays: Bools) -> LikelyPath:
        """Return the most likely path if one of the N landmarks is not there.

        Only the stretches with rays (R,) of the landmark lose it. The other stretches did without it already, and keep the
        costs of the whole map. The first call computes and keeps these costs. In a warehouse with 17,000 rays, to take the
        landmark from all stretches took four times as long.
        """
        changed = np.bincount(self.sight.stretch[rays], minlength=len(self.middle)) > 0
        left = self.landmarks.take(self.known != landmark)
        new = self.sight.of_stretches(changed).costs(left)
        kept = zip(changed.tolist(), self._kept, strict=True)
        return self._along(next(new) if other else cells.astype(np.float32) for other, cells in kept)

    @cached_property
    def _kept(self) -> list[NDArray[np.float16]]:
        """The costs (Y, X, X) of all stretches. They take 21 kB each: 41 MB for ten minutes in a warehouse."""
        return [cells.astype(np.float16) for cells in self.sight.costs(self.landmarks)]

    @cached_property
    def _motions(self) -> Motions:
        return Motions.of(self.keyframes, self.middle, self.map_T_base[self.middle], self.sight.grid)

    def _along(self, costs: Iterator[Cells]) -> LikelyPath:
        """Return the most likely path for the costs of all stretches."""
        grid, pivot, base = self.sight.grid, self.sight.pivot, self.map_T_base[self.middle]
        correction = lift_se2(most_likely_states(self._motions, costs, grid))
        correction[:, :3, 3] += pivot - np.einsum("gij,gj->gi", correction[:, :3, :3], pivot)
        stamps = self.keyframes.stamps
        path = correct_poses(stamps, self.map_T_base, stamps[self.middle], base, correction @ base)
        return LikelyPath(path, grid.turn / 2, grid.shift / 2)


def _spacing(positions: Floats, label: Ints) -> float:
    """Return the median distance (m) from a landmark to the nearest other landmark of its label, inf if no label has two
    landmarks."""
    from scipy.spatial import cKDTree

    nearest = [np.zeros(0)]
    for one in np.unique(label):
        mine = positions[label == one]
        if len(mine) > 1:
            nearest.append(np.asarray(cKDTree(mine).query(mine, k=2)[0])[:, 1])
    each = np.concatenate(nearest)
    return float(np.median(each)) if len(each) else np.inf
