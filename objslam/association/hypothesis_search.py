"""Search for points on which many rays of one label agree, from pairs of rays."""

from dataclasses import dataclass, replace

import numpy as np

from objslam.association.observations import MIN_DEPTH, RANGE_LIMIT, SIZE_SPREAD, Observations, closest_approach
from objslam.core.array_module import Backend, Tensor, array_backend, as_numpy, as_tensor, module_of
from objslam.core.arrays import Bools, Floats, Ints

_PAIRS_AT_ONCE = {"numpy": 1 << 16, "cpu": 1 << 16, "cuda": 1 << 24}
"""The most pairs of a ray and a point scored together, for each backend. On a CPU, this number of pairs fits into the cache.
On CUDA, a smaller number needs more calls: on an H100, 400,000,000 pairs took 141 ms with 2^18, and 12 ms with 2^22 to
2^28."""
_LARGE = 1 << 26
"""The least number of pairs of a ray and a point that CUDA scores, if there is a card. With fewer pairs, the start of CUDA
costs more than it saves. An H100 scores 2^26 pairs in 2 ms, and numpy in 0.2 s."""
_DRAWS_EACH = 8  # The number of ray pairs drawn for each hypothesis. Most pairs of rays do not meet.
_REFINEMENTS = 2  # The number of least-squares refinements of each hypothesis. A larger value costs time.
_MIN_LEFT = 0.6
"""The share of its support that a point must keep without the rays of better points. A point with less is left to a later
search. A larger share leaves more points."""
_SAME = 0.6
"""A point is the same as an excluded one if the rays that support both give it at least this share of its support. With a
larger share, more points near an excluded one are found."""
_SINGLE_EXTENT = 30.0  # The largest extent (m) of the origins for single precision. Beyond it, millimetres would be lost.
WRONG_RANGE = 0.6
"""The share of a ray's support that a wrong range takes away, unless `Search.wrong_range` says otherwise. A larger value
trusts ranges more."""
_SIZE_PAIRS = 4000
"""The number of pairs of rays drawn to find the usual size of a label. With a larger number, the size is more exact and
takes more time."""
_SAME_SIZE = 0.25
"""The largest difference of ln size between two boxes that show the same size. With a larger value, the usual size is less
exact."""
_USUAL = 0.2
"""The least share of the pairs of meeting rays that show the usual size of a label. In simulated rows of equal things the
share was 0.24 to 0.31. With a larger share, fewer labels have a usual size."""
_CLEARLY_USUAL = 0.1
"""The least share of the pairs that show the usual size, for a size that is clear (`_RIVAL`). In a longer row, fewer pairs
are rays to one thing. The share was 0.13 to 0.18 along simulated streets with cars and lamp posts. With a larger share,
fewer labels have a usual size."""
_RIVAL = 3.0
"""The usual size is clear if its number of pairs is at least this multiple of the number of pairs of any other size. Along
the simulated streets, the multiple was 5 to 9. For a wrong size, of cars that hid each other, it was 2.3. With a larger
multiple, fewer labels have a usual size."""
_LARGER = 1 + RANGE_LIMIT * SIZE_SPREAD
"""A pair of rays meets too far away if its boxes show a thing larger than this multiple of the usual size. With a larger
value, farther points count as the thing."""
_BEYOND = 0.2
"""Sizes count if at least this share of the pairs of meeting rays meets too far away. The share was 0.28 to 0.34 in
simulated rows of equal things, and at most 0.12 in rooms. With a larger share, sizes count in fewer logs."""
_LADDER = (0.7, 1.0, 1.5, 2.2, 3.3, 5.0, 7.5, 11.0)  # The distances (m) tried along rays without parallax.


@dataclass(frozen=True)
class Search:
    """The settings of a search. hypotheses: the most tried points where two rays meet. The ends of ranges and points along
    single rays come in addition. support: least support of a point. gate: largest squared deviation of a ray that supports a
    point. parallax: least angle (rad) between the rays of a pair. With 0, distances along single rays are also tried.
    device: the setting `triangulation.device`. wrong_range: the share of a ray's support that a wrong range takes away."""

    hypotheses: int
    support: float
    gate: float
    parallax: float
    device: str
    wrong_range: float = WRONG_RANGE


def ranged_by_size(obs: Observations, sized: Bools, gate: float, parallax: float, seed: int) -> Observations:
    """Return the rays, with ranges from the sizes of boxes where no range is known and many rays meet too far away.

    The size of a box times the distance of the thing is similar for all things of a label. Where rays to several things meet
    far away, the boxes show a larger thing. sized: (R,) whether the box of each ray shows a size. gate, parallax: as in
    `Search`. seed: the seed of the random pairs.
    """
    sized = sized & (obs.size > 0).all(axis=1)
    away, sigma = obs.range.copy(), obs.range_sigma.copy()
    for label in np.unique(obs.label[sized & ~np.isfinite(away)]).tolist():
        rays = np.flatnonzero(sized & (obs.label == label))
        usual = _usual_size(obs.take(rays), gate, parallax, np.random.default_rng([seed, label]))
        if usual is not None:
            rays = rays[~np.isfinite(away[rays])]
            away[rays] = usual[1] / obs.size[rays, usual[0]]
            sigma[rays] = SIZE_SPREAD * away[rays]
    return replace(obs, range=away, range_sigma=sigma)


def _usual_size(obs: Observations, gate: float, parallax: float, rng: np.random.Generator) -> tuple[int, float] | None:
    """Return a side of the things of one label, 0 for the width and 1 for the height, and the usual size (m) of this side.

    More pairs of meeting rays show this size than any other. The side on which more pairs agree is returned, because the
    other side may change with the view. The result is None if too few pairs show one size, or if few pairs meet so far away
    that they show a much larger thing.
    """
    first, second = _draw(obs, _SIZE_PAIRS, rng)
    meet, depth1, depth2, _ = _meeting(obs, first, second, gate, parallax)
    one, two = (np.log(obs.size[i[meet]] * depth[meet, None]) for i, depth in ((first, depth1), (second, depth2)))
    middle, best, least = (one + two) / 2, None, _CLEARLY_USUAL * len(one)
    for side in (0, 1):
        shown = np.sort(middle[np.abs(one - two)[:, side] < _SAME_SIZE, side])
        begin, end = np.searchsorted(shown, [shown - _SAME_SIZE / 2, shown + _SAME_SIZE / 2])
        number = end - begin
        if not len(shown) or number.max() < least:
            continue
        top = number.argmax()
        rival = number[np.abs(shown - shown[top]) > 2 * _SAME_SIZE].max(initial=0)
        if number[top] >= _USUAL * len(one) or number[top] >= _RIVAL * rival:
            best, least = (side, float(shown[begin[top] : end[top]].mean())), number[top]
    if best is None or (middle[:, best[0]] > best[1] + np.log(_LARGER)).mean() < _BEYOND:
        return None
    return best[0], float(np.exp(best[1]))


def discover(
    obs: Observations,
    search: Search,
    rng: np.random.Generator,
    excluded: Floats | None = None,
    judged: Observations | None = None,
) -> Floats:
    """Return the points (N, 3) m on which rays of one label agree. The point with the most support comes first.

    Each hypothesis is scored against all rays at once. In each frame only the best ray counts: 1 for a perfect fit, 0 at the
    gate. The support of a point excludes the rays of better points. excluded: (M, 3) m, points that must not be
    found. judged: the rays with the ranges that support is judged by, if these differ from the ranges that propose points.
    """
    points = _propose(obs, search, rng)
    if len(points) == 0:
        return points
    with array_backend(search.device, len(points) * len(obs) >= _LARGE) as backend:
        scorer = _Scorer(obs if judged is None else judged, search, backend)
        return _best(scorer, points, search, np.zeros((0, 3)) if excluded is None else excluded)


def _best(scorer: "_Scorer", points: Floats, search: Search, excluded: Floats) -> Floats:
    """Refine points (H, 3) m, and return the points (N, 3) m that have enough support even without the rays of better
    points."""
    moved, xp = scorer.load(points), scorer.xp
    for _ in range(_REFINEMENTS):
        moved = scorer.refine(moved, scorer.supports(moved))
    support = scorer.supports(moved)
    whole = scorer.per_frame(support)
    for other in scorer.supports(scorer.load(excluded)):
        same = scorer.per_frame(xp.minimum(support, other)) >= _SAME * whole
        support[same], whole[same] = 0.0, 0.0
    left, found = 1 * whole, []
    for _ in range(len(moved)):
        best = int(xp.where(left >= _MIN_LEFT * whole, left, 0.0).argmax())
        if float(left[best]) < max(search.support, _MIN_LEFT * float(whole[best])):
            break
        found.append(best)
        taken = support[best] > scorer.doubt
        left -= support[:, taken].sum(axis=1)
        support[:, taken] = 0.0
    return as_numpy(moved[found]).astype(np.float64) + scorer.centre


def _propose(obs: Observations, search: Search, rng: np.random.Generator) -> Floats:
    """Return the points (H, 3) m where two rays of different frames meet, and where ranges end. If `search.parallax` is 0,
    points along single rays are added."""
    n = len(obs)
    # If there are fewer pairs than hypotheses, each pair is tried once. This is both faster and complete.
    few, draws = n * (n - 1) // 2 <= search.hypotheses, _DRAWS_EACH * search.hypotheses
    first, second = np.triu_indices(n, 1) if few else _draw(obs, draws, rng)
    meet, _, _, middle = _meeting(obs, first, second, search.gate, search.parallax)
    points = [middle[meet][: search.hypotheses]]
    ranged = np.flatnonzero(np.isfinite(obs.range))
    if len(ranged):
        some = rng.permutation(ranged)[: search.hypotheses // 2]
        points.append(obs.origin[some] + obs.range[some, None] * obs.direction[some])
    if search.parallax == 0:
        some = rng.permutation(len(obs))[: search.hypotheses // len(_LADDER)]
        ladder = np.array(_LADDER)[:, None, None] * obs.direction[some]
        points.append((obs.origin[some] + ladder).reshape(-1, 3))
    return np.concatenate(points)


def _meeting(
    obs: Observations, first: Ints, second: Ints, gate: float, parallax: float
) -> tuple[Bools, Floats, Floats, Floats]:
    """Return which pairs (P,) of rays of different frames meet, the distances (P,) m along both rays, and the midpoints
    (P, 3) m. gate, parallax: as in `Search`."""
    depth1, depth2, middle, apart2, sin2 = closest_approach(obs, first, second)
    limit = (obs.sigma[first] * depth1) ** 2 + (obs.sigma[second] * depth2) ** 2 + 2 * obs.position_sigma**2
    meet = (depth1 > MIN_DEPTH) & (depth2 > MIN_DEPTH) & (apart2 <= gate * limit)
    meet &= (obs.frame[first] != obs.frame[second]) & (sin2 >= max(np.sin(parallax), 1e-3) ** 2)
    return meet, depth1, depth2, middle


def _draw(obs: Observations, count: int, rng: np.random.Generator) -> tuple[Ints, Ints]:
    """Draw `count` pairs of rays, and return their indices. A pair with only one ray is left out, or has the same ray twice.

    If the first ray has a track, the second ray has the same track with probability 0.5. In all other cases, the logarithm
    of the number of rays between the two is uniform, because near frames more often show the same object.
    """
    n = len(obs)
    first = rng.integers(n, size=count)
    reach = np.exp(rng.uniform(0.0, np.log(max(n, 2)), count)).astype(np.int64)
    second = first + reach * rng.choice([-1, 1], count)
    second = np.where((second < 0) | (second >= n), first - (second - first), second)
    order = np.argsort(obs.track, kind="stable")
    begin, end = (np.searchsorted(obs.track[order], obs.track[first], side=side) for side in ("left", "right"))
    mate = order[begin + (rng.random(count) * (end - begin)).astype(np.int64)]
    second = np.where((obs.track[first] >= 0) & (rng.random(count) < 0.5), mate, second)
    inside = (second >= 0) & (second < n)
    return first[inside], second[inside]


class _Scorer:
    """Scores points by the rays of one label.

    The rays are sorted into slices. Slice k, from 0, contains the (k + 1)-th ray of every frame with more than k rays.
    Frames with more rays come first, so place i of every slice belongs to the same frame. A running maximum over the slices
    gives the best support in each frame.
    """

    def __init__(self, obs: Observations, search: Search, backend: Backend) -> None:
        _, frame, number = np.unique(obs.frame, return_inverse=True, return_counts=True)
        rank = np.arange(len(obs)) - (np.cumsum(number) - number)[frame]  # The rays of a frame are adjacent.
        self.slices = np.bincount(rank).tolist()
        obs = obs.take(np.lexsort((frame, -number[frame], rank)))
        self.centre = obs.origin.mean(axis=0)
        origin = obs.origin - self.centre
        self.backend = backend
        self.dtype = np.float32 if np.abs(origin).max() < _SINGLE_EXTENT else np.float64
        n, zero, one = obs.direction, np.zeros(len(obs)), np.ones(len(obs))
        self.ahead = self._tensor(np.stack([*n.T, zero, -(n * origin).sum(axis=1)]))
        self.xp = module_of(self.ahead)
        self.apart2 = self._tensor(np.stack([*(-2 * origin.T), one, (origin**2).sum(axis=1)]))
        self.slope, self.floor = self._tensor(search.gate * obs.sigma**2), search.gate * obs.position_sigma**2 + 1e-9
        across = np.eye(3) - n[:, :, None] * n[:, None, :]
        self.across = self._tensor(across.reshape(-1, 9))
        self.foot = self._tensor((across @ origin[:, :, None])[:, :, 0])
        self.range, self.doubt, self.wrong = None, 0.0, search.wrong_range
        ranged = np.isfinite(obs.range)
        if ranged.any():
            precision = np.where(ranged, 1 / obs.range_sigma, 0.0)
            self.range = self._tensor(np.where(ranged, obs.range, 0.0)), self._tensor(precision)
            self.doubt = 1 - WRONG_RANGE  # A ray with less support may have a wrong range, or see an object behind.

    def _tensor(self, values: Floats) -> Tensor:
        return as_tensor(np.ascontiguousarray(values, dtype=self.dtype), self.backend)

    def load(self, points: Floats) -> Tensor:
        """Convert points (H, 3) m in map to an array of the backend, relative to the mean camera position."""
        return self._tensor(points - self.centre)

    def supports(self, points: Tensor) -> Tensor:
        """Return the support (H, R) of each point by each ray. It falls with the squared deviation, from 1 for a perfect fit
        to 0 at the gate. A wrong range also reduces it."""
        xp = self.xp
        p = xp.concat([points, (points**2).sum(axis=1)[:, None], xp.ones_like(points[:, :1])], axis=1)
        out = xp.empty((len(p), self.ahead.shape[1]), dtype=p.dtype, device=p.device)
        step = max(1, _PAIRS_AT_ONCE[self.backend] // self.ahead.shape[1])
        for i in range(0, len(p), step):
            depth = (p[i : i + step] @ self.ahead).clip(min=1e-3)  # No ray supports a point behind its camera.
            depth2 = depth * depth
            part = xp.matmul(p[i : i + step], self.apart2, out=out[i : i + step])
            part -= depth2
            depth2 *= self.slope
            depth2 += self.floor
            part /= depth2
            xp.clip(1 - part, 0.0, 1.0, out=part)
            if self.range is not None:
                wrong = (depth - self.range[0]) * (self.range[1] / RANGE_LIMIT)
                wrong *= wrong
                part *= 1 - (self.wrong * wrong).clip(max=self.wrong)
        return out

    def per_frame(self, support: Tensor) -> Tensor:
        """Return the sum over the frames (H,) of the best support in each frame. support: (H, R)."""
        xp = self.xp
        best, at = 1 * support[:, : self.slices[0]], self.slices[0]
        for width in self.slices[1:]:
            xp.maximum(best[:, :width], support[:, at : at + width], out=best[:, :width])
            at += width
        return best.sum(axis=1)

    def refine(self, points: Tensor, support: Tensor) -> Tensor:
        """Move points (H, 3) to the least-squares solution of the rays, with the weights `support` (H, R). A point does not
        move in directions that its rays do not fix."""
        xp = self.xp
        information = (support @ self.across).reshape(-1, 3, 3)
        trace = information[:, 0, 0] + information[:, 1, 1] + information[:, 2, 2]
        damping = (1e-3 * trace + 1e-6)[:, None]
        information = information + damping[:, :, None] * xp.eye(3, dtype=points.dtype, device=points.device)
        return xp.linalg.solve(information, (support @ self.foot + damping * points)[:, :, None])[:, :, 0]
