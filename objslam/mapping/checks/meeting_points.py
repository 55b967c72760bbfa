"""Fit points to the rays of each label, for all labels at once: how many boxes can a few things in the world explain?

The rays of a label stand in one row of a table. Labels with similar numbers of rays share a table, so a row has few empty
places.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any, Self

import numpy as np

from objslam.core.arrays import Bools, Floats, Ints

_PAIRS = 256
"""The most tried pairs of rays for a point. More pairs find points with fewer rays, and take longer. With 96, the verdict on
one MRCLAM robot depends on the random pairs. With 256, none of 8 seeds changes the verdict, but scores still vary by up to
7 %."""
_JUDGES = 400
"""The most rays of a label that choose among the tried points. More rays choose better, and take longer in a crowd."""
_FEWEST = 4
"""The fewest rays of a point. Fewer rays agree by chance."""
_LEAST_ANGLE = np.radians(4.0)
"""The least angle between the rays of a point (rad). Rays with a smaller angle agree even if the input is wrong."""
_NARROW = 0.9
"""The least share of nearly parallel rays of a label that lie within `_LEAST_ANGLE` of their mean direction. Nearly parallel
rays neither meet nor miss. With a smaller share, false rays count as nearly parallel too."""
_NEAREST = 0.25
"""The least distance (m) of a point from a camera. Rays of a turning camera meet in the camera itself. A larger distance
loses points near a camera."""
_MOST_POINTS = 40
"""The most points of one label. More points explain more boxes by chance."""
_REFITS = 2
"""The number of least-squares fits to the rays of a point. More fits are more exact, and take longer."""
_CANDIDATES = 8
"""The most tried points of a label, from the best on, that are examined in one round. A tried point fails if its rays come
from one direction only. If all fail, the label has no more points. Rays along a row of things all pass a far point, which
would hide the things of the row. A larger number finds points in longer rows, and takes longer."""
_MANY = 100
"""The fewest remaining rays of a label for which a second tried point is examined. A row of things has hundreds of rays.
Fewer rays may meet by chance, such as the rays of a camera that somebody moved. A smaller number finds shorter rows."""
_TABLE = 1 << 17
"""The most pairs of a tried point and a ray in one table. A larger table needs fewer passes, but does not fit into the
processor's cache."""


@dataclass(frozen=True)
class Meeting:
    """The points in which R rays meet. point: (R,) the index of each ray's point in `points`, -1 for none. points: (N, 3) m.

    fit: (R,) how well each ray fits its point: 1 on the point, 0 beyond the tolerance, 0 without a point. narrow: (R,)
    whether a ray neither meets nor misses, because the remaining rays of its label are nearly parallel.
    """

    point: Ints
    points: Floats
    fit: Floats
    narrow: Bools


@dataclass(frozen=True)
class _Rows:
    """The rays of L labels, one label a row. number: (L, N) the index of each ray. real: (L, N) False for an empty place.
    origins: (L, N, 3) m, relative to `middle`. directions: (L, N, 3) of unit length. tolerance: (L, N) rad. place: m, as in
    `fit_points`. middle: (L, 3) m, the mean of the origins."""

    number: Ints
    real: Bools
    origins: Floats
    directions: Floats
    tolerance: Floats
    place: float
    middle: Floats

    @classmethod
    def of(cls, number: Ints, real: Bools, rays: tuple[Floats, Floats, Floats], place: float) -> Self:
        """Return the rows of some rays. rays: the origins, directions and tolerances of all rays."""
        origins, directions, tolerance = (each[number] for each in rays)
        middle = (origins * real[:, :, None]).sum(axis=1) / real.sum(axis=1)[:, None]
        return cls(number, real, origins - middle[:, None], directions, tolerance, place, middle)

    def some(self, places: Ints, real: Bools) -> Self:
        """Return the rays at some places (L, J) of each row. real: (L, J), False for an empty place."""
        at = np.arange(len(places))[:, None], places
        changed = self.number[at], real, self.origins[at], self.directions[at], self.tolerance[at]
        return type(self)(*changed, self.place, self.middle)

    def labels(self, chosen: Ints) -> Self:
        """Return the rows of some labels (C,)."""
        taken: dict[str, Any] = {name: value[chosen] for name, value in vars(self).items() if name != "place"}
        return replace(self, **taken)

    def fit(self, points: Floats) -> Floats:
        """Return how well (L, P, N) each ray fits each point of its label: 1 on the ray, 0 from the tolerance on.

        points: (L, P, 3) m from the middle.
        """
        o, d = self.origins, self.directions
        # `along` and `squared` are sums of products. A matrix product makes each in one pass over the table.
        squares = np.einsum("lpi,lpi->lp", points, points)[:, :, None]
        of_points = np.concatenate([points, np.ones_like(squares), squares], axis=2)
        along = of_points[:, :, :4] @ np.concatenate([d, -np.einsum("lni,lni->ln", o, d)[:, :, None]], axis=2).swapaxes(1, 2)
        own = np.einsum("lni,lni->ln", o, o)[:, :, None]
        squared = of_points @ np.concatenate([-2 * o, own, np.ones_like(own)], axis=2).swapaxes(1, 2)
        np.maximum(squared, 0.0, out=squared)
        counts = (along > _NEAREST) & self.real[:, None]
        across = np.subtract(squared, np.square(along, out=along), out=along)
        np.maximum(across, 0.0, out=across)
        squared *= (self.tolerance**2)[:, None]
        squared += max(self.place**2, 1e-12)
        fit = np.subtract(1.0, np.divide(across, squared, out=across), out=across)
        np.maximum(fit, 0.0, out=fit)
        fit *= counts
        return np.asarray(fit)


def fit_points(origins: Floats, directions: Floats, tolerance: Floats, place: float, label: Ints, seed: int) -> Meeting:
    """Return the points in which the rays of each label meet. The labels do not affect each other.

    origins: (R, 3) m. directions: (R, 3) of unit length. tolerance: (R,) rad. place: m. A ray fits a point if it passes
    within the tolerance times the distance, and `place`, added in quadrature. label: (R,) the label of each ray. seed: for
    the random pairs of rays.
    """
    rng = np.random.default_rng(seed)
    rays = (origins, directions, tolerance)
    owner = np.unique(label, return_inverse=True)[1]
    point, gain, points = np.full(len(label), -1), np.zeros(len(label)), [np.zeros((0, 3))]
    narrow = np.zeros(len(label), dtype=bool)
    left = np.argsort(owner, kind="stable")
    for _ in range(_MOST_POINTS):  # Each round finds the best point of each label among the rays that are left.
        dice, again, found = rng.random((2, max(_PAIRS, _JUDGES))), [left[:0]], sum(map(len, points))
        for rows in _tables(left, owner[left], rays, place):
            best, fit, good = _best_points(rows, dice)
            fits = (fit > 0) & good[:, None]
            which = np.nonzero(fits)
            point[rows.number[fits]] = found + (np.cumsum(good) - 1)[which[0]]
            gain[rows.number[fits]] = fit[fits]
            points.append((best + rows.middle)[good])
            found += int(good.sum())
            again.append(rows.number[rows.real & ~fits & good[:, None]])
            narrow[rows.number[rows.real & (~good & _nearly_parallel(rows))[:, None]]] = True
        left = np.concatenate(again)
        if not len(left):
            break
        left = left[np.argsort(owner[left], kind="stable")]
    return Meeting(point, np.concatenate(points), gain, narrow)


def nearest_point(origins: Floats, directions: Floats, start: Floats, used: Bools | None = None) -> Floats:
    """Return the points (..., 3) with the least sum of squared angles to rays (..., N, 3).

    start: (..., 3) points near the returned points. Their distances from the cameras turn offsets into angles. used:
    (..., N) which rays count, None for all.
    """
    to = start[..., None, :] - origins
    weight = 1 / np.maximum(np.einsum("...ni,...ni->...n", to, to), _NEAREST**2)
    if used is not None:
        weight = weight * used
    weighted = weight[..., None] * directions
    along = np.einsum("...ni,...ni->...n", directions, origins)
    matrix = weight.sum(axis=-1)[..., None, None] * np.eye(3) - weighted.swapaxes(-1, -2) @ directions
    vector = np.einsum("...n,...ni->...i", weight, origins) - np.einsum("...ni,...n->...i", weighted, along)
    return np.asarray(np.linalg.solve(matrix + 1e-9 * np.eye(3), (vector + 1e-9 * start)[..., None])[..., 0])


def _tables(left: Ints, owner: Ints, rays: tuple[Floats, Floats, Floats], place: float) -> Iterator[_Rows]:
    """Yield the rays in tables, with one label a row. A label with too few rays is in no table.

    left: (R,) the numbers of the rays, in the order of their labels. owner: (R,) the label of each ray.
    """
    begin = np.flatnonzero(np.diff(owner, prepend=-1))
    size = np.diff(begin, append=len(owner))
    labels = np.argsort(size, kind="stable")
    labels = labels[size[labels] >= _FEWEST]
    while len(labels):
        width = size[labels]
        fits = np.arange(1, len(labels) + 1) * _tried(width) * np.minimum(width, _JUDGES) <= _TABLE
        count = max(1, int(fits.sum()))
        mine, labels = labels[:count], labels[count:]
        column = np.arange(size[mine[-1]])
        real = column < size[mine][:, None]
        yield _Rows.of(left[begin[mine][:, None] + np.where(real, column, 0)], real, rays, place)


def _tried(rays: Ints) -> Ints:
    """Return how many pairs of rays are tried for each label. rays: the number of rays of each label."""
    return np.minimum(_PAIRS, rays * (rays - 1) // 2)


def _best_points(rows: _Rows, dice: Floats) -> tuple[Floats, Floats, Bools]:
    """Return the best point (L, 3) of each label, how well each ray (L, N) fits this point, and which labels (L,) have a
    point.

    dice: (2, M) random numbers from 0 to 1, M at least _PAIRS and _JUDGES. All labels use the same numbers, so no label
    affects another.
    """
    size = rows.real.sum(axis=1)
    points, ahead = _tried_points(rows, size, dice)
    judges = min(_JUDGES, rows.real.shape[1])
    column = np.arange(judges)
    drawn = ((column + dice[0, :judges]) * (size / judges)[:, None]).astype(np.int64)  # One ray of each stretch.
    many = size[:, None] > judges
    chosen = rows.some(np.where(many, drawn, column), column < size[:, None]) if many.any() else rows
    score = np.where(ahead, chosen.fit(points).sum(axis=2), -1.0)
    order = np.argsort(-score, axis=1, kind="stable")[:, :_CANDIDATES]
    point, gain, found = np.zeros((len(size), 3)), np.zeros(rows.real.shape), np.zeros(len(size), dtype=bool)
    left = np.arange(len(size))  # The labels whose candidates so far were seen from one direction.
    for k in range(order.shape[1]):
        left = left[ahead[left, order[left, k]]]
        if not len(left):
            break
        mine = rows if len(left) == len(size) else rows.labels(left)
        best, fit, around = _refitted(mine, points[left, order[left, k]])
        enough = (fit > 0).sum(axis=1) >= _FEWEST
        good = left[enough & around]
        point[good], gain[good], found[good] = best[enough & around], fit[enough & around], True
        left = left[enough & ~around & (size[left] >= _MANY)]
    return point, gain, found


def _refitted(rows: _Rows, best: Floats) -> tuple[Floats, Floats, Bools]:
    """Return points (L, 3) that are fitted to their rays from a start (L, 3), how well each ray fits them (L, N), and which
    points (L,) were seen from around."""
    fit = rows.fit(best[:, None])[:, 0]
    for _ in range(_REFITS):
        moved = nearest_point(rows.origins, rows.directions, best, fit > 0)
        other = rows.fit(moved[:, None])[:, 0]
        better = other.sum(axis=1) > fit.sum(axis=1)
        best, fit = np.where(better[:, None], moved, best), np.where(better[:, None], other, fit)
    return best, fit, _seen_from_around(rows, best, fit > 0)


def _nearly_parallel(rows: _Rows) -> Bools:
    """Return the labels (L,) whose rays are so close to parallel that they do not determine a point."""
    mean = (rows.directions * rows.real[:, :, None]).sum(axis=1)
    mean /= np.maximum(np.linalg.norm(mean, axis=1, keepdims=True), 1e-9)
    near = (np.einsum("lni,li->ln", rows.directions, mean) >= np.cos(_LEAST_ANGLE)) & rows.real
    return np.asarray(near.sum(axis=1) >= _NARROW * rows.real.sum(axis=1))


def _tried_points(rows: _Rows, size: Ints, dice: Floats) -> tuple[Floats, Bools]:
    """Return the points (L, P, 3) where pairs of rays come closest, and which of them (L, P) are ahead of both cameras.

    All pairs of a label are tried if there are few enough, else random pairs. Points that are ahead come first. The other
    points only fill the rows, which all have the same length.
    """
    tried = int(_tried(size).max())
    order = np.arange(tried)
    second = ((1 + np.sqrt(1 + 8 * order)) / 2).astype(np.int64)  # The pairs (0, 1), (0, 2), (1, 2), (0, 3), ...
    first = order - second * (second - 1) // 2
    every = (size * (size - 1) // 2 <= _PAIRS)[:, None]
    one = (dice[0, :tried] * size[:, None]).astype(np.int64)
    other = (one + 1 + (dice[1, :tried] * (size - 1)[:, None]).astype(np.int64)) % size[:, None]
    real = order < _tried(size)[:, None]
    labels, width = rows.real.shape
    row = width * np.arange(labels)[:, None]
    # The axis of x, y and z comes first, because NumPy is slow if the last axis is short.
    origins, directions = (np.ascontiguousarray(each.reshape(-1, 3).T) for each in (rows.origins, rows.directions))
    a, b = (row + np.where(real, np.where(every, x, y), 0) for x, y in ((first, one), (second, other)))
    o_a, d_a, o_b, d_b = (each.take(at, axis=1) for at in (a, b) for each in (origins, directions))
    cos, between = _dots(d_a, d_b), o_b - o_a
    sin2 = 1 - cos**2
    wide = real & (sin2 > np.sin(_LEAST_ANGLE / 2) ** 2)
    along_a, along_b = (_dots(between, d) for d in (d_a, d_b))
    sin2 = np.where(wide, sin2, 1.0)
    s, t = (along_a - cos * along_b) / sin2, (cos * along_a - along_b) / sin2
    points = (o_a + s * d_a + o_b + t * d_b) / 2
    ahead = wide & (s > _NEAREST) & (t > _NEAREST)
    some = np.argsort(~ahead, axis=1, kind="stable")[:, : max(1, int(ahead.sum(axis=1).max()))]
    return np.stack([np.take_along_axis(each, some, axis=1) for each in points], axis=2), np.take_along_axis(
        ahead, some, axis=1
    )


def _dots(a: Floats, b: Floats) -> Floats:
    """Return the products (L, P) of vectors (3, L, P)."""
    return np.asarray(a[0] * b[0] + a[1] * b[1] + a[2] * b[2])


def _seen_from_around(rows: _Rows, points: Floats, inside: Bools) -> Bools:
    """Return which points (L, 3) are seen from directions that differ enough. inside: (L, N) the rays of each point."""
    to = points[:, None] - rows.origins
    to /= np.maximum(np.linalg.norm(to, axis=2, keepdims=True), 1e-9)
    first = np.take_along_axis(to, inside.argmax(axis=1)[:, None, None], axis=1)
    cos = np.where(inside, np.einsum("lni,lki->ln", to, first), 1.0)
    return np.asarray(cos.min(axis=1) <= np.cos(_LEAST_ANGLE))
