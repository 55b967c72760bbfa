"""Find places of boxes without an object: points with more rays close by than chance explains."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from objslam.association.observations import MIN_DEPTH, Observations, closest_approach
from objslam.association.refinement import refine
from objslam.core.arrays import Bools, Floats, Ints
from objslam.mapping.doubts.chance import LEAST_LOG_ODDS, crowded
from objslam.mapping.doubts.evidence import Evidence

_FEWEST = 3
"""The fewest rays of a group. Two rays nearly always pass closely somewhere. A larger number finds fewer groups."""
_SCALES = (1.0, 3.0)
"""The largest distances of a ray from its place, in gates, in two searches. The first search finds rays that meet. The
second also finds rays that only pass nearby. Larger numbers find looser groups, and join different groups more often."""
_LOOSE = 2.0
"""The limit on the number of rays that the second search finds, as a multiple of the number in the first. Above it, the rays
only pass nearby and do not meet. With a larger number, more loose groups count as groups that meet."""
_AROUND = 4.0
"""The surroundings of a place reach to this multiple of the largest distance at which a ray passes the place. A larger
multiple gives a surer estimate of how many rays pass by chance, from a larger area."""
_FLAT = 0.5
"""The largest angle (rad) of the surroundings, seen from a camera. Wider surroundings are not flat, so the number of rays
that pass by chance does not follow from their area. A larger angle counts places nearer to the path."""
_PAIRS = 3000
"""The number of pairs of rays that are tried for a label. More pairs find groups of fewer rays, and take longer."""
_NEXT = 30
"""The largest number of boxes between the two boxes of half of the pairs. A place is seen for a while, so such pairs often
show one place. A smaller number finds small groups in long logs better, with less parallax."""
_PLACES, _SAMPLE = 600, 3000
"""The most places that are tried for a label, and the most rays that are counted at these places. Larger numbers find
smaller groups, and take longer."""
_MOST = 12
"""The most groups of one label. Nobody reads a report with more."""
_PARALLAX = np.radians(1.0) ** 2
"""The least squared sine of the angle between two rays whose crossing is tried. With a smaller value, more of the tried
places are far away."""
_FAR = 3.0
"""The greatest distance of a crossing that counts, as a multiple of the greatest distance at which an object was seen. A
larger multiple tries more places far away."""


def crossings(evidence: Evidence, left: Ints) -> Iterator[Ints]:
    """Yield groups of rays. The rays of a group pass close to one place. left: (M,) the rays without an object."""
    obs, usual = evidence.state.obs, evidence.state.distance
    reach = _FAR * float(usual.max()) if len(usual) else np.inf
    order = np.argsort(obs.label[left], kind="stable")
    for mine in np.split(left[order], np.flatnonzero(np.diff(obs.label[left[order]])) + 1):
        if len(mine) >= _FEWEST:
            yield from _of_label(evidence, mine, reach)


def _of_label(evidence: Evidence, mine: Ints, reach: float) -> Iterator[Ints]:
    """Yield groups of the rays (M,) of one label. reach: m, the greatest distance of a place from the cameras."""
    obs, factor = evidence.state.obs, float(evidence.state.class_noise[evidence.state.obs.label[mine[0]]])
    rng = np.random.default_rng(len(mine))
    if len(mine) > _SAMPLE:
        mine = np.sort(rng.choice(mine, _SAMPLE, replace=False))
    places = _places(obs, mine, reach, rng)
    if not len(places):
        return
    radius = factor * np.sqrt(evidence.gate)
    deviation = _deviations(obs.take(mine), places, _SCALES[-1] * _AROUND * radius) / radius
    free, open_ = np.ones(len(mine), dtype=bool), np.ones((len(_SCALES), len(places)), dtype=bool)
    for _ in range(_MOST):
        inside = np.array([(deviation <= scale) & free for scale in _SCALES])
        number = inside.sum(axis=2)
        around = np.array([((deviation <= _AROUND * scale) & free).sum(axis=1) for scale in _SCALES])
        odds = crowded(number - 2, around - 2, 1 / _AROUND**2, len(places))  # Two rays define each place.
        odds[~open_ | (number < _FEWEST)] = 0.0
        standing_out = np.flatnonzero(odds.max(axis=1) >= LEAST_LOG_ODDS)
        if not len(standing_out):
            break
        scale = int(standing_out[0])
        place = int(odds[scale].argmax())
        open_[scale, place] = False
        loose = np.flatnonzero(number[:, place] > _LOOSE * number[scale, place])  # A loose crowd includes the narrow one.
        scale = max([scale, *loose.tolist()])
        group = _gathered(obs, mine, free, places[place], inside[scale, place], _SCALES[scale] * radius)
        if group.sum() >= _FEWEST:
            free &= ~group
            yield mine[group]


def _places(obs: Observations, mine: Ints, reach: float, rng: np.random.Generator) -> Floats:
    """Return places (P, 3), m, where pairs of the rays `mine` (M,) cross ahead of both cameras, at most `reach` (m) away."""
    first = rng.integers(len(mine), size=_PAIRS)
    far = rng.integers(len(mine), size=_PAIRS)
    near = np.clip(first + rng.integers(1, _NEXT + 1, size=_PAIRS), 0, len(mine) - 1)
    second = np.where(np.arange(_PAIRS) % 2, near, far)
    # Each pair is tried once, because every further place makes a crowd by chance more likely.
    pairs = np.unique(np.minimum(first, second) * len(mine) + np.maximum(first, second))
    pairs = rng.permutation(pairs)
    first, second = mine[pairs // len(mine)], mine[pairs % len(mine)]
    different = obs.frame[first] != obs.frame[second]
    first, second = first[different], second[different]
    one, two, middle, gap2, sin2 = closest_approach(obs, first, second)
    allowed = (_SCALES[-1] * obs.sigma[first] * np.maximum(one, 0.0)) ** 2 * 9 + (6 * obs.position_sigma) ** 2
    good = (np.minimum(one, two) > MIN_DEPTH) & (np.maximum(one, two) < reach) & (gap2 <= allowed) & (sin2 > _PARALLAX)
    places: Floats = middle[good][:_PLACES]
    return places


def _deviations(obs: Observations, places: Floats, widest: float = 0.0) -> Floats:
    """Return the distance (P, R) at which each ray passes each place, in standard deviations.

    The distance is inf for a place behind the camera, and for a place so near to the camera that the surroundings fill the
    view. widest: the deviation up to which the surroundings reach.
    """
    centre = obs.origin.mean(axis=0)
    point, origin = places - centre, obs.origin - centre
    depth = point @ obs.direction.T - (origin * obs.direction).sum(axis=1)
    squared = (point**2).sum(axis=1)[:, None] + (origin**2).sum(axis=1) - 2 * point @ origin.T
    across = np.maximum(squared - depth**2, 0.0)
    noise = obs.sigma**2 * squared + obs.position_sigma**2 + 1e-12
    flat = noise * widest**2 <= _FLAT**2 * squared
    return np.where((depth > MIN_DEPTH) & flat, np.sqrt(across / noise), np.inf)


def _gathered(obs: Observations, mine: Ints, free: Bools, place: Floats, group: Bools, radius: float) -> Bools:
    """Return which rays (M,) pass the point that fits best to a first group of rays.

    mine: (M,) the rays. free: (M,) the rays that may be taken. place: (3,) m, where the fit starts. group: (M,) the first
    group. radius: the largest deviation of a ray that passes the point.
    """
    for _ in range(2):
        index = np.zeros(int(group.sum()), dtype=np.int64)
        moved = refine(obs, mine[group], index, place[None], np.ones(1))
        again = (_deviations(obs.take(mine), moved)[0] <= radius) & free
        if again.sum() < group.sum():
            break
        group, place = again, moved[0]
    return group
