"""Replace two landmarks at crossings by the two things whose rays cross there.

Seen from two stretches of the path, two things of one label have four points where rays meet: the things, and two ghosts.
The rays of each ghost come from both things. Both ghosts together have as many rays as both things together. The rays from a
short part of the path fit the ghosts well. So no ray of one ghost fits the other ghost better. A search that finds the
points one by one may find the ghosts first. Only rays from a third side reveal the ghosts. Such rays fit both ghosts worse
than the rays of other landmarks fit their own landmarks.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from objslam.association.landmarks import State
from objslam.association.observations import MIN_DEPTH, Observations, closest_approach
from objslam.association.refinement import ray_costs, refine
from objslam.core.arrays import Floats, Ints
from objslam.core.geometry import nearest_points
from objslam.core.statistics import grouped_median

_NEIGHBOURS = 8
"""The number of nearest landmarks that each landmark is tried with. A larger number finds ghosts further apart, and is
slower."""
_DRAWN = 400
"""The number of pairs of rays that propose points for two landmarks. A larger number finds points with fewer rays, and is
slower."""
_POINTS = 120
"""The most proposed points that are tried in pairs. A larger number is slower: all pairs of points are scored."""
_RAYS = 300
"""The number of rays that score pairs of points. The same few rays then compare the best pair with the two landmarks. If
they prefer the pair, all rays compare it with the landmarks. A larger number is slower."""
_LEAST_GAIN = 30.0
"""The least decrease of -2 ln of the likelihood of two landmarks' rays with which two new points replace the landmarks. Rays
share errors, so a small decrease may be chance. With a larger value, fewer ghosts are replaced."""
_STEPS = 4
"""The rounds of assigning the rays to two points and refining the points. More rounds are more exact, and slower."""
_GAUSSIAN = 2.0
"""The mean squared deviation of a landmark's own rays, if their noise is as expected (chi-squared, 2 degrees of freedom). A
larger value tries fewer pairs."""
_LEAST_SIN2 = np.sin(np.radians(5.0)) ** 2
"""The least squared sine of the angle between two rays that propose a point. With a larger angle, the points are surer, but
fewer."""


def replace_ghosts(state: State, gate: float, tried: set[bytes], seed: int = 0) -> State:
    """Replace each pair of landmarks of one label by two other points if these explain the rays of both clearly better.

    Args:
        state: landmarks at solved or given poses.
        gate: the squared deviation of a ray that belongs to no landmark.
        tried: the rays of each pair that was tried at these poses. Such a pair is not tried again. New pairs are added.
        seed: the seed of the random pairs of rays.
    Returns:
        The state with new positions, and with the rays assigned to them. The same state if no pair was replaced.
    """
    position, matched = state.landmarks.position.copy(), state.matched.copy()
    taken = np.zeros(state.count, dtype=bool)
    for pair in _suspects(state, gate):
        if taken[pair].any():
            continue
        held = np.flatnonzero(np.isin(state.matched, pair))
        if (key := held.tobytes()) in tried:
            continue
        tried.add(key)
        obs, noise = state.obs.take(held), float(state.class_noise[state.label[pair[0]]])
        found = _best_points(obs, noise, gate, np.random.default_rng([seed, *pair]))
        if found is None:
            continue
        few = _some(obs)
        if _settled(few, found, noise, gate)[2] >= _settled(few, position[pair], noise, gate)[2]:
            continue
        _, _, now = _settled(obs, position[pair], noise, gate)
        points, owner, cost = _settled(obs, found, noise, gate)
        if cost < now - _LEAST_GAIN:
            taken[pair] = True
            position[pair], matched[held] = points, pair[owner]
    if not taken.any():
        return state
    return replace(state, landmarks=replace(state.landmarks, position=position), matched=matched)


def _suspects(state: State, gate: float) -> Ints:
    """Return the pairs (P, 2) of neighbours of one label whose rays fit clearly worse than the rays of most landmarks of the
    label, the worst pair first."""
    if state.count < 2:
        return np.zeros((0, 2), dtype=np.int64)
    label, number = state.label, state.ray_count
    deviation = state.deviation / state.class_noise[label][state.owner]
    mean = np.bincount(state.owner, np.minimum(deviation**2, gate), state.count) / np.maximum(number, 1)
    usual = np.minimum(grouped_median(mean, label, len(state.class_noise)), _GAUSSIAN)
    excess = np.maximum(mean - usual[label], 0.0) * number
    near = nearest_points(state.landmarks.position, min(_NEIGHBOURS + 1, state.count))
    pairs = np.stack([np.repeat(np.arange(state.count), near.shape[1]), near.ravel()], axis=1)
    pairs = np.unique(np.sort(pairs, axis=1), axis=0)
    total = excess[pairs].sum(axis=1)
    tried = (pairs[:, 0] != pairs[:, 1]) & (label[pairs[:, 0]] == label[pairs[:, 1]]) & (total > _LEAST_GAIN)
    return np.asarray(pairs[tried][np.argsort(-total[tried], kind="stable")])


def _best_points(obs: Observations, noise: float, gate: float, rng: np.random.Generator) -> Floats | None:
    """Return the two points (2, 3) that explain the rays best, among random points where two rays meet. None if fewer than
    two pairs of rays meet."""
    first, second = rng.integers(len(obs), size=(2, _DRAWN))
    depth1, depth2, middle, _, sin2 = closest_approach(obs, first, second)
    points = middle[(depth1 > MIN_DEPTH) & (depth2 > MIN_DEPTH) & (sin2 > _LEAST_SIN2)][:_POINTS]
    if len(points) < 2:
        return None
    costs = _costs(_some(obs), points, noise, gate)
    together = np.stack([np.minimum(one, costs).sum(axis=1) for one in costs])
    return np.asarray(points[list(np.unravel_index(together.argmin(), together.shape))])


def _some(obs: Observations) -> Observations:
    """Return every n-th ray, about `_RAYS` of them."""
    return obs.take(np.unique(np.linspace(0, len(obs) - 1, _RAYS).astype(np.int64)))


def _settled(obs: Observations, points: Floats, noise: float, gate: float) -> tuple[Floats, Ints, float]:
    """Assign the rays to two points and refine the points, in turn. Return the points (2, 3), the point (R,) of each ray,
    and -2 ln likelihood of the rays."""
    every = np.arange(len(obs))
    for _ in range(_STEPS):
        points = refine(obs, every, _costs(obs, points, noise, gate).argmin(axis=0), points, np.full(len(points), noise))
    costs = _costs(obs, points, noise, gate)
    return points, costs.argmin(axis=0), float(costs.min(axis=0).sum())


def _costs(obs: Observations, points: Floats, noise: float, gate: float) -> Floats:
    """Return -2 ln likelihood (P, R) of each ray for each of P points, as in `ray_costs`."""
    every = np.tile(np.arange(len(obs)), len(points))
    return ray_costs(obs, np.repeat(points, len(obs), axis=0), noise, gate, every).reshape(len(points), -1)
