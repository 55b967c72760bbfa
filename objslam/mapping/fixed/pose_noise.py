"""Estimate the noise of given poses, from the errors that all rays of a frame share.

A wrong heading of a pose turns all rays of its frame to one side. A wrong place shifts them to one side. The noise of boxes
differs from ray to ray. So frames that show several objects reveal the noise of the poses, even if the noise of boxes is
unknown."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from objslam.association.observations import MIN_DEPTH
from objslam.config import Settings
from objslam.core.arrays import Bools, Floats, Ints
from objslam.core.noise import MOST_NOISE
from objslam.core.statistics import NORMAL_MEDIAN
from objslam.core.types import Association, Keyframes, Rays
from objslam.frontend.up import upright
from objslam.graph.fixed_pose_triangulation import noise_of_poses

_FEWEST = 4
"""The fewest rays of an object that is used. Two rays determine the place of the object. With a larger number, fewer objects
are used."""
_MOST_POSES = 500
"""The most poses that count, spread evenly. They determine a factor to 3 %. With a larger number, the factors are more
exact, and the estimate is slower."""
_BOUNDS = np.log([[0.4, 1.0, 1.0], [5.0, MOST_NOISE, MOST_NOISE]])
"""The logarithms of the least and largest factors on the noise of rays, headings and places. The noise of poses never falls
below the settings, because a few frames with small errors say nothing about the other frames. With wider bounds, poses may
be noisier."""
_STEPS = (0.8, 0.4, 0.2, 0.1, 0.05, 0.025)
"""The steps of the search, as logarithms of factors. With a smaller last step, the search is more exact and slower."""
_CHANCE = 1e-3
"""The probability of a false alarm, which finds more noise in poses that have the noise of the settings. With a larger
value, shorter logs can show noisy poses, but more good logs seem to have such poses."""
_SIGNIFICANT = -2 * np.log(_CHANCE)
"""The least amount by which more noise must lower -2 ln of the posterior density, so that the poses count as noisier. It is
the quantile of chi-squared that is exceeded with the probability `_CHANCE`. There are 2 degrees of freedom: the noise of
headings and the noise of places."""
_STRAY = 3.0
"""The least deviation of a stray ray, in standard deviations of all noise together. Stray rays do not count. With a larger
number, false boxes raise the noise. With a smaller number, the noise of true boxes becomes too small. The number 3 lowers it
by 1.3 %."""
_ROUNDS = 4
"""The most rounds that separate stray rays from noisy poses. More rounds hardly change a factor."""


@dataclass(frozen=True)
class _Sums:
    """Sums over the rays of each of K poses, in units of the nominal noise of rays.

    shared: (K, 3, 3) the information about the error of each pose in heading (rad), x and y (m). pulled: (K, 3) this
    information times the error that fits best. squares: the sum of the squared misses of all rays. rays: the number of rays.
    noise: (3,) the nominal standard deviations of the error in heading (rad), x and y (m). prior: the weight of the nominal
    noise, as a number of residuals.
    """

    shared: Floats
    pulled: Floats
    squares: float
    rays: int
    noise: Floats
    prior: float

    def cost(self, logarithms: Floats) -> float:
        """Return -2 ln of the posterior density of the logarithms (3,) of the factors on rays, headings and places."""
        factors = np.exp(logarithms)
        sigma = self.noise * factors[[1, 2, 2]]
        inner = np.eye(3) + sigma[:, None] * self.shared * sigma / factors[0] ** 2
        pulled = self.pulled * sigma / factors[0] ** 2
        explained = (pulled * np.linalg.solve(inner, pulled[:, :, None])[:, :, 0]).sum()
        likelihood = self.squares / factors[0] ** 2 - explained + np.log(np.linalg.det(inner)).sum()
        likelihood += 2 * self.rays * logarithms[0]
        return float(likelihood + self.prior * (2 * logarithms + factors**-2.0).sum())


def noise_in_frames(
    keyframes: Keyframes, rays: Rays, association: Association, positions: Floats, settings: Settings
) -> tuple[float, float]:
    """Return the factors (at least 1) on `localization.yaw` and `localization.xy` that agree best with the rays.

    This is a variance component model (Searle, Casella and McCulloch 1992). Seen from above, the miss of a ray is a sum of
    three errors: the noise of the ray, the error of its pose's heading, and the error of its pose's place. The found sizes
    of the three errors have the largest posterior density. Both factors are 1 unless the rays refute the settings. Only
    poses with two rays or more count, because a single ray does not show which of the three errors it has.

    positions: (N, 3) m, NaN for an object without a position.
    """
    number = np.bincount(association.object[association.object >= 0], minlength=association.count)
    usable = np.append(np.isfinite(positions[:, 0]) & (number >= _FEWEST), False)
    held = np.flatnonzero(usable[association.object])  # The index -1 (no object) gives the last entry.
    held, pose = of_several(keyframes, rays, held, _MOST_POSES)
    if not len(held) or not keyframes.localized_every:
        return 1.0, 1.0
    owner = association.object[held]
    up = upright(keyframes)
    origin, direction = (values[held] @ up.T for values in rays.in_map(keyframes.map_T_camera))
    to = positions[owner] @ up.T - origin
    level = np.maximum(np.hypot(to[:, 0], to[:, 1]), MIN_DEPTH)
    left = np.column_stack([-to[:, 1], to[:, 0]]) / level[:, None]
    miss = (direction[:, :2] * left).sum(axis=1) / np.maximum(np.hypot(direction[:, 0], direction[:, 1]), 1e-6)
    miss *= np.sqrt(number[owner] / (number[owner] - 2))  # The place of an object is fitted to its own rays.
    own = rays.sigma[held] * np.maximum(np.linalg.norm(to, axis=1), MIN_DEPTH) / level
    by_pose = np.column_stack([np.ones(len(held)), left / level[:, None]])
    yaw, place = noise_of_poses(replace(keyframes, pose_noise=(1.0, 1.0)), settings)
    usual = np.hypot(own, np.hypot(yaw, place / level))
    factors = np.full(3, max(1.0, float(np.median(np.abs(miss) / usual)) / NORMAL_MEDIAN))
    inside = np.zeros(len(held), dtype=bool)
    for _ in range(_ROUNDS):
        total = np.hypot(own * factors[0], np.hypot(yaw * factors[1], place * factors[2] / level))
        near = np.abs(miss) < _STRAY * total
        near &= np.bincount(pose, near)[pose] > 1
        if not near.any():
            return 1.0, 1.0
        if np.array_equal(near, inside):
            break
        inside = near
        sums = _summed(miss[near] / own[near], by_pose[near] / own[near, None], pose[near], (yaw, place), settings)
        factors = _most_likely(sums)
    return float(factors[1]), float(factors[2])


def _summed(miss: Floats, by_pose: Floats, pose: Ints, noise: tuple[float, float], settings: Settings) -> _Sums:
    """Return the sums over the rays of each pose. miss: (R,) the misses. by_pose: (R, 3) the derivative of each miss by the
    error of the pose. Both are in standard deviations of the rays. pose: (R,) the pose of each ray. noise: the noise of
    headings (rad) and of places (m)."""
    count, pose = len(np.unique(pose)), np.unique(pose, return_inverse=True)[1]
    shared, pulled = np.zeros((count, 3, 3)), np.zeros((count, 3))
    np.add.at(shared, pose, by_pose[:, :, None] * by_pose[:, None, :])
    np.add.at(pulled, pose, by_pose * miss[:, None])
    yaw, place = noise
    return _Sums(shared, pulled, float(miss @ miss), len(miss), np.array([yaw, place, place]), settings.noise.prior)


def _most_likely(sums: _Sums) -> Floats:
    """Return the factors (3,) on the noise of rays, headings and places with the least cost.

    The factors on headings and places are 1 unless larger factors cost significantly less."""
    usual, cost_usual = least_cost(sums.cost, np.array([True, False, False]), np.zeros(3), _BOUNDS)
    found, cost = least_cost(sums.cost, np.ones(3, dtype=bool), usual, _BOUNDS)
    return np.exp(found if cost < cost_usual - _SIGNIFICANT else usual)


def of_several(keyframes: Keyframes, rays: Rays, held: Ints, most: int) -> tuple[Ints, Ints]:
    """Return the rays among `held` (n,) whose pose has several rays of `held`, and the number of the pose of each returned
    ray.

    Keyframes with one stamp share a pose. most: the most poses that are kept, spread evenly.
    """
    pose = np.unique(keyframes.stamps, return_inverse=True)[1][rays.keyframe[held]]
    several = np.flatnonzero(np.bincount(pose) > 1)
    some = np.isin(pose, several[:: -(-len(several) // most) or 1])
    return held[some], pose[some]


def least_cost(cost: Callable[[Floats], float], free: Bools, start: Floats, bounds: Floats) -> tuple[Floats, float]:
    """Return the logarithms (n,) of factors with the least cost, and this cost. The search takes steps along the axes, which
    become smaller.

    free: (n,) which factors may change. start: (n,) the first logarithms. bounds: (2, n) the least and largest
    logarithms."""
    best, least = start, cost(start)
    moves = np.concatenate([np.eye(len(start)), -np.eye(len(start))])[np.tile(free, 2)]
    for step in _STEPS:
        moved = True
        while moved:
            moved = False
            for move in moves:
                other = np.clip(best + step * move, *bounds)
                if (tried := cost(other)) < least - 1e-9:
                    best, least, moved = other, tried, True
    return best, least
