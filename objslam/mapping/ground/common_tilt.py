"""The roll, pitch and height that planar poses lack, from the errors that all rays of a pose share.

If the robot pitches, all rays of its pose go up or down. If it rolls, the rays on one side go up, and the rays on the other
side go down. If it stands higher than its pose says, near rays go down more than far ones. The noise of boxes does not move
rays together. So poses that show several things reveal how uneven the ground is.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import combinations_with_replacement, product
from typing import Self

import numpy as np

from objslam.association.observations import MIN_DEPTH
from objslam.core.arrays import Floats, Ints
from objslam.core.types import Keyframes, Rays
from objslam.errors import SolveError
from objslam.mapping.fixed.pose_noise import least_cost, of_several

_MOST_POSES = 300
"""The most poses that count, spread evenly. More poses are more exact and slower."""
_HEIGHT = 3.0
"""The prior standard deviation (m) of the error of the height of a thing. With a larger value, the rays decide more."""
_MOUNT = 0.1
"""The prior standard deviation (rad) of the roll and tilt of a camera on the robot. A larger value takes more of a constant
tilt for an error of the camera."""
_PLACE = 0.1
"""The prior standard deviation (m) of x and of y of a pose. A robot that is nearer to its things than its pose says sees
them farther up or down. A larger value takes more of the tilt for such errors."""
_BOUNDS = np.log([[0.3, 1e-4, 1e-4], [5.0, 0.35, 10.0]])
"""The logarithms of the least and the largest values of three numbers: the factor on the noise of rays, the tilt (rad) and
the height (m). Wider bounds allow rougher ground."""
_TILTS, _HEIGHTS = (0.003, 0.01, 0.03, 0.1), (1e-4, 0.1)
"""The tilts (rad) and heights (m) at which the search may begin. The search begins at the likeliest pair. More values are
slower."""
_STRAY = 3.5
"""The least deviation of a ray that is left out as a stray, in standard deviations of the noise that remains. A larger
number lets false boxes raise the tilt."""
_MOST_LASTING, _RUN = 150, 10
"""The most poses from which the duration of a tilt is estimated, and the number of consecutive poses in one run. More poses
are more exact, and the time grows with their cube. Longer runs show short durations less often."""
_TIMES = tuple(0.25 * 2.0**k for k in range(9))
"""The tried times (s) for which a tilt lasts. The shortest time fits a bump, and the longest fits a slope. More times give a
finer result and are slower."""
_LARGER = (1.0, 1.5, 2.25)
"""The tried sizes of a tilt that lasts, as multiples of the size of a tilt that is new in each pose. More sizes give a finer
result and are slower."""
_CHANCE = 1e-3
"""The probability that flat ground is found uneven. With a larger value, shorter logs can show uneven ground."""
SIGNIFICANT = -2 * np.log(_CHANCE)
"""The least decrease of -2 ln of the likelihood by tilt and height for which the ground counts as uneven. It is the quantile
of chi-squared that is exceeded with the probability `_CHANCE`. The 2 degrees of freedom are tilt and height."""


@dataclass(frozen=True)
class _Poses:
    """Sums over the rays of K poses, for P effects that are equal in all poses. Rays are in units of their noise, and
    effects in units of their priors.

    shared: (K, n, n) the information about the errors of each pose: roll, pitch (rad), height (m), and perhaps x and y (m).
    So n is 3 or 5. pulled: (K, n) this information times the error that fits best. crossed: (K, n, P) the information
    between the errors of a pose and the effects. information: (P, P) the information about the effects. vector: (P,) this
    information times the effects that fit best. squares: the sum of the squared misses. rays: the number of rays. prior: as
    `Noise.prior`.
    """

    shared: Floats
    pulled: Floats
    crossed: Floats
    information: Floats
    vector: Floats
    squares: float
    rays: int
    prior: float

    @classmethod
    def of(cls, miss: Floats, by_pose: Floats, effects: Floats, pose: Ints, prior: float) -> Self:
        """Return the sums over rays. miss: (R,) the misses. by_pose: (R, n), effects: (R, P) their derivatives by the errors
        of the poses and by the effects. pose: (R,) the pose of each ray, in increasing order."""
        begin = np.flatnonzero(np.diff(pose, prepend=-1))
        return cls(
            shared=np.add.reduceat(by_pose[:, :, None] * by_pose[:, None, :], begin),
            pulled=np.add.reduceat(by_pose * miss[:, None], begin),
            crossed=np.add.reduceat(by_pose[:, :, None] * effects[:, None, :], begin),
            information=effects.T @ effects,
            vector=effects.T @ miss,
            squares=float(miss @ miss),
            rays=len(miss),
            prior=prior,
        )

    @cached_property
    def _shared(self) -> Floats:
        """(n, n, K) `shared` with the poses along the last axis, because NumPy is slow if the last axis is short."""
        return np.ascontiguousarray(np.moveaxis(self.shared, 0, -1))

    @cached_property
    def _told(self) -> Floats:
        """(n, 1 + P, K) `pulled` and `crossed` as columns of one array, with the poses along the last axis."""
        return np.ascontiguousarray(np.moveaxis(np.concatenate([self.pulled[:, :, None], self.crossed], axis=2), 0, -1))

    def solve(self, logarithms: Floats, alike: Floats | None = None) -> tuple[float, Floats, Floats]:
        """Return -2 ln of the restricted likelihood, the effects (P,), and the errors of the poses (K, n).

        logarithms: (3,) the logarithms of the factor on the noise of rays, of the tilt (rad), and of the height (m). alike:
        (K, K) the correlation between the errors of two poses, None if they are independent. Raises a SolveError if the
        system is not finite.
        """
        return self.solved(logarithms, None if alike is None else self.independent(alike))

    def independent(self, alike: Floats) -> tuple[Floats, Floats, Floats]:
        """Return the arguments of `solved` that depend only on the correlation between the errors of two poses.

        All poses become one. Its errors of each kind are sums of independent numbers. The returned values are the factors
        (K, K) of the independent numbers in the sums, and `_told` (n, 1 + P, K) and `shared` (n, n, K, K) of the numbers.
        alike: as in `solve`.
        """
        root = np.linalg.cholesky(alike + 1e-9 * np.eye(len(alike)))
        count = len(self._shared)
        shared = np.empty((count, count, *root.shape))
        for i, j in combinations_with_replacement(range(count), 2):
            shared[i, j] = shared[j, i] = root.T @ (self._shared[i, j, :, None] * root)
        return np.asarray(root, dtype=np.float64), np.asarray(self._told @ root), shared

    def solved(self, logarithms: Floats, independent: tuple[Floats, Floats, Floats] | None) -> tuple[float, Floats, Floats]:
        """Return the same as `solve`. independent: what the method `independent` returns, None for independent errors."""
        factor, tilt, height = np.exp(logarithms)
        sigma = np.array([tilt, tilt, height, _PLACE, _PLACE])[: self.pulled.shape[1]] / factor
        if independent is None:
            white, logarithm, back = _of_each(
                self._shared * np.outer(sigma, sigma)[..., None], self._told * sigma[:, None, None]
            )
        else:
            root, told, inner = independent
            told, inner = sigma[:, None, None] * told, np.outer(sigma, sigma)[..., None, None] * inner
            count = told.shape[0] * told.shape[2]
            inner = inner.swapaxes(1, 2).reshape(count, count)
            white, logarithm, back = _of_all(inner, told.swapaxes(1, 2).reshape(count, -1))
        gram = white.T @ white
        total = self.information - gram[1:, 1:] + np.eye(len(self.vector)) * factor**2
        vector = self.vector - gram[1:, 0]
        found = np.linalg.solve(total, vector)
        squares = (self.squares - gram[0, 0] - vector @ found) / factor**2
        cost = squares + logarithm + np.linalg.slogdet(total)[1]
        cost += 2 * (self.rays - len(found)) * logarithms[0] + self.prior * (2 * logarithms[0] + factor**-2.0)
        errors = back(white[:, 0] - white[:, 1:] @ found).reshape(len(sigma), -1)
        if independent is not None:
            errors = errors @ root.T
        return float(cost), found, (sigma[:, None] * errors).T

    def cost(self, logarithms: Floats) -> float:
        """Return -2 ln of the restricted likelihood."""
        return self.solve(logarithms)[0]


@dataclass(frozen=True)
class Uneven:
    """How uneven the ground is.

    tilt: rad, the standard deviation of roll and of pitch. height: m, the standard deviation of the height. seconds: s, the
    time after which the correlation of tilts and of heights is 1/e, 0 if each pose has a new tilt and height. share: the
    noise that tilt and height add to a usual ray, as a multiple of its other noise. gain: the decrease of -2 ln of the
    restricted likelihood by tilt and height.
    """

    tilt: float
    height: float
    seconds: float = 0.0
    share: float = 0.0
    gain: float = 0.0


@dataclass(frozen=True)
class CommonTilt:
    """The fit of a variance component model to the elevations of rays. Rays are in units of their noise.

    ground: the unevenness, if each pose has a new tilt and height. logarithms: (3,) as in `_Poses.solve`. stamps: (R,) s.
    pose: (R,) the pose of each ray. miss: (R,), by_pose: (R, 5), effects: (R, P) as in `_Poses.of`. prior: as `Noise.prior`.
    """

    ground: Uneven
    logarithms: Floats
    stamps: Floats
    pose: Ints
    miss: Floats
    by_pose: Floats
    effects: Floats
    prior: float

    def lasting(self) -> Uneven:
        """Return the ground with the most likely duration of its tilt, and with the size that the tilt has at this duration.

        A tilt that lasts moves all rays of a thing up or down together, so the rays still meet. The rays show only a part of
        the tilt. The whole tilt is larger.
        """
        poses = np.unique(self.pose)
        every = -(-len(poses) // _MOST_LASTING)
        some = np.isin(self.pose, poses[np.arange(len(poses)) // _RUN % every == 0])
        index = np.unique(self.pose[some], return_inverse=True)[1]
        sums = _Poses.of(self.miss[some], self.by_pose[some, :3], self.effects[some], index, self.prior)
        stamps = self.stamps[some][np.flatnonzero(np.diff(index, prepend=-1))]
        gaps = np.abs(stamps[:, None] - stamps)
        tried = [(sums.solve(self.logarithms)[0], 0.0, 1.0)]
        for seconds in _TIMES:
            independent = sums.independent(np.exp(-gaps / seconds))  # All tried sizes share it.
            larger = [self.logarithms + np.log([1.0, times, times]) for times in _LARGER]
            costs = [sums.solved(logarithms, independent)[0] for logarithms in larger]
            tried += [(cost, seconds, times) for cost, times in zip(costs, _LARGER, strict=True)]
        _, seconds, times = min(tried)
        return replace(self.ground, tilt=self.ground.tilt * times, height=self.ground.height * times, seconds=seconds)


_Solved = tuple[Floats, float, Callable[[Floats], Floats]]
"""The solution of a system 1 + A = L L^T. The three values are the right-hand sides L^-1 B, the logarithm of the determinant
of 1 + A, and a function that solves L^T for one right-hand side."""


def _of_each(inner: Floats, told: Floats) -> _Solved:
    """Return the solutions of the systems of K poses, each with n unknowns, by elimination for all poses at once.

    inner: (n, n, K) the matrices A. told: (n, m, K) the right-hand sides B. The rows of the solution are by unknown, then by
    pose. NumPy would call LAPACK for each pose, which takes three times as long.
    """
    n, m, poses = told.shape
    rows = np.concatenate([inner, told], axis=1)
    rows[np.arange(n), np.arange(n)] += 1.0
    for i in range(n - 1):
        share = rows[i + 1 :, i] / rows[i, i]
        rows[i + 1 :, i + 1 :] -= share[:, None] * rows[i, i + 1 :]
    pivots = _positive(rows[np.arange(n), np.arange(n)])
    rows /= np.sqrt(pivots)[:, None]

    def back(white: Floats) -> Floats:
        found = white.reshape(n, poses).copy()
        for i in range(n - 1, -1, -1):
            found[i] = (found[i] - (rows[i, i + 1 : n] * found[i + 1 :]).sum(axis=0)) / rows[i, i]
        return found.ravel()

    return rows[:, n:].swapaxes(1, 2).reshape(n * poses, m), float(np.log(pivots).sum()), back


def _of_all(inner: Floats, told: Floats) -> _Solved:
    """Return the solution of one system. inner: (n, n) the matrix A. told: (n, m) the right-hand sides B."""
    from scipy.linalg.lapack import dpotrf, dtrtrs  # Here, so that `load_libraries` comes first.

    root, _ = dpotrf((inner + np.eye(len(inner))).T, lower=1, clean=0, overwrite_a=1)
    pivots = _positive(np.diagonal(root))  # If LAPACK failed, a pivot is not positive or not finite.
    white, _ = dtrtrs(root, told, lower=1)
    return (
        white,
        float(2 * np.log(pivots).sum()),
        lambda right: np.asarray(dtrtrs(root, right, lower=1, trans=1)[0]),
    )


def _positive(pivots: Floats) -> Floats:
    """Return the pivots of the factorisation of 1 + A (`_Solved`). Raises a SolveError if a pivot is not finite and
    positive.

    If all rays are finite, 1 + A is positive definite, and its pivots are positive.
    """
    if not (np.isfinite(pivots) & (pivots > 0)).all():
        raise SolveError("the errors that the rays of a pose share are not finite")
    return pivots


def common_tilt(keyframes: Keyframes, rays: Rays, point: Ints, points: Floats, prior: float) -> CommonTilt | None:
    """Return how uneven the ground is below planar poses. None if no pose has several rays, or the rays of no pose share an
    error.

    A variance component model (Searle, Casella and McCulloch 1992). The elevation of a ray above its thing is a sum of four
    terms: the noise of the ray, the errors of its pose (roll, pitch, height, x, y), the error of the height of the thing,
    and constant errors of its camera (roll, tilt). The variances maximise the restricted likelihood.

    point: (R,) the thing of each ray, -1 for none. points: (N, 3) m, the things. prior: the weight of the nominal noise of
    rays, as a number of residuals.
    """
    held = np.flatnonzero(point >= 0)
    held, pose = of_several(keyframes, rays, held, _MOST_POSES)
    order = np.argsort(pose, kind="stable")
    held, pose = held[order], pose[order]
    if not len(held):
        return None
    miss, by_pose, effects = _derivatives(keyframes, rays, held, point, points)
    white = rays.sigma[held]
    miss, by_pose, effects = miss / white, by_pose / white[:, None], effects / white[:, None]
    near = np.ones(len(held), dtype=bool)
    for last in (False, True):
        index = np.unique(pose[near], return_inverse=True)[1]
        sums = _Poses.of(miss[near], by_pose[near], effects[near], index, prior)
        level, flat = least_cost(sums.cost, np.array([True, False, False]), np.array([0.0, *_BOUNDS[0, 1:]]), _BOUNDS)
        if not last:
            starts = [np.array([size, *np.log(one)]) for one in product(_TILTS, _HEIGHTS) for size in (level[0], 0.0)]
            found = min(starts, key=sums.cost)
            if sums.cost(found) > flat:
                return None
        found, cost = least_cost(sums.cost, np.ones(3, dtype=bool), found, _BOUNDS)
        if last:
            break
        _, shared, own = sums.solve(found)
        left = np.full(len(miss), np.inf)
        left[near] = miss[near] - effects[near] @ shared - (by_pose[near] * own[index]).sum(axis=1)
        near = np.abs(left) < _STRAY * np.exp(found[0])
        near &= np.bincount(pose, near)[pose] > 1
        if not near.any():
            return None
    tilt, height = np.exp(found[1:]).tolist()
    moved = np.hypot(tilt * np.hypot(by_pose[:, 0], by_pose[:, 1]) / np.sqrt(2), height * by_pose[:, 2])
    ground = Uneven(tilt, height, share=float(np.median(moved)), gain=flat - cost)
    stamps = keyframes.stamps[rays.keyframe[held[near]]]
    return CommonTilt(ground, found, stamps, pose[near], miss[near], by_pose[near], effects[near], prior)


def _derivatives(keyframes: Keyframes, rays: Rays, held: Ints, point: Ints, points: Floats) -> tuple[Floats, Floats, Floats]:
    """Return the angles (R,), rad, by which rays pass above their things, and two derivatives of these angles.

    The first derivatives (R, 5) are by the roll, pitch, height, x and y of the pose. The second derivatives (R, P) are by
    the heights of the things and by the roll and tilt of the cameras. These are in units of their prior standard deviations.
    """
    origin, direction = (values[held] for values in rays.in_map(keyframes.map_T_camera))
    to = points[point[held]] - origin
    level = np.maximum(np.hypot(to[:, 0], to[:, 1]), MIN_DEPTH)
    across = np.maximum(np.hypot(direction[:, 0], direction[:, 1]), 1e-6)
    ahead = direction[:, :2] / across[:, None]
    miss = np.arctan2(direction[:, 2], across) - np.arctan2(to[:, 2], level)
    by_height = level / np.maximum(level**2 + to[:, 2] ** 2, MIN_DEPTH**2)
    nearer = to[:, 2:] / np.maximum(level**2 + to[:, 2] ** 2, MIN_DEPTH**2)[:, None] * to[:, :2] / level[:, None]
    by_pose = np.column_stack([-ahead[:, 1], ahead[:, 0], by_height, nearer])
    of_base = np.einsum("rji,rj->ri", keyframes.map_T_base[rays.keyframe[held], :2, :2], ahead)
    things, index = np.unique(point[held], return_inverse=True)
    camera = keyframes.camera[rays.keyframe[held]]
    effects = np.zeros((len(held), len(things) + 2 * (int(camera.max()) + 1)))
    row = np.arange(len(held))
    effects[row, index] = -_HEIGHT * by_height
    for column, values in enumerate((of_base[:, 0], of_base[:, 1])):
        effects[row, len(things) + 2 * camera + column] = _MOUNT * values
    return miss, by_pose, effects
