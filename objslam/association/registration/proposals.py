"""Propose transforms between two maps: pairs of objects with equal labels and equal distances."""

import numpy as np
from scipy.spatial import KDTree

from objslam.association.registration.fitting import Problem, move
from objslam.association.registration.shapes import Shape, Vectors
from objslam.core.arrays import Array, Floats, Ints

_PAIRS = 6000
"""The most pairs of objects of one map that propose transforms. The two orders of a pair count as two pairs. A larger number
finds smaller overlaps and takes longer. The number was chosen for time, not by a sweep."""
_MIN_PARTNERS = 6
"""The least number of other objects with which each object is paired, even beyond `_PAIRS`. A larger number takes longer."""
_MIN_BASE = 6.0
"""The least distance between the two objects of a pair, in standard deviations of their difference. A larger value gives
better headings and fewer pairs. At 6, the heading of a pair has a standard deviation below 1/6 rad in each map."""
_GATE = 3.0
"""The largest difference of two pairs' lengths, in standard deviations. A larger value proposes more wrong transforms."""
_MAX_PROPOSALS = 60_000
"""The most proposals that are compared. Pairs with few similar pairs come first. A larger number takes longer."""
_NEIGHBOURS = 12
"""The number of nearest objects by which proposals are compared. A larger number ranks better and takes longer."""
_AT_ONCE = 1 << 17
"""The most differences of neighbours computed together. A larger number needs more memory, which does not fit into the cache
of a processor: with 2^20, the comparison took 2.5 times as long as with 2^15 to 2^18."""


def _pairs(m: Shape, spread: Floats) -> tuple[Ints, Ints]:
    """Return the pairs (P,), (P,) of each object and its nearest partners that are far enough for a heading (`_MIN_BASE`).

    spread: (N,) m^2, the horizontal variance of each object.
    """
    count = len(m.label)
    partners = min(count - 1, max(_MIN_PARTNERS, _PAIRS // count))
    distance, index = KDTree(m.position[:, :2]).query(m.position[:, :2], k=min(count, 3 * partners + 1))
    far = distance > _MIN_BASE * np.sqrt(spread[:, None] + spread[index])
    i, column = np.nonzero(far & (np.cumsum(far, axis=1) <= partners))
    return i, np.asarray(index)[i, column]


def propose(problem: Problem) -> tuple[Ints, Floats, int]:
    """Return H proposals: the first object (H,) of each pair in a, the transforms (H, 4), and the number of tried proposals.

    A transform is x, y, z (m) and yaw (rad) of map a in map b. The origin of each map is its centre. H is at most
    `_MAX_PROPOSALS`.
    """
    a, b = problem.a, problem.b
    (i, j), (k, n) = _pairs(a, problem.spread_a), _pairs(b, problem.spread_b)
    in_a, in_b = a.vectors(i, j), b.vectors(k, n)
    labels = int(a.label.max()) + 1
    key = (b.label[k] * labels + b.label[n]) * 2 * problem.apart + in_b.length
    order = np.argsort(key, kind="stable")
    middle = (a.label[i] * labels + a.label[j]) * 2 * problem.apart + in_a.length
    reach = np.minimum(_reach(in_a, in_b, b.size_variance), problem.apart / 4)
    begin, end = np.searchsorted(key[order], middle - reach), np.searchsorted(key[order], middle + reach, side="right")
    number = end - begin
    rare = np.argsort(number, kind="stable")
    rare = rare[np.cumsum(number[rare]) <= _MAX_PROPOSALS]
    p = np.repeat(rare, number[rare])
    step = np.arange(len(p)) - np.repeat(np.cumsum(number[rare]) - number[rare], number[rare])
    q = order[begin[p] + step]
    fits = np.abs(in_a.length[p] - in_b.length[q]) <= _GATE * np.sqrt(in_a.length_variance[p] + in_b.length_variance[q])
    rise_variance = in_a.rise_variance[p] + in_b.rise_variance[q]
    fits &= np.abs(in_a.base[p, 2] - in_b.base[q, 2]) <= _GATE * np.sqrt(rise_variance)
    share = fits.mean() if len(fits) else 0.0
    p, q = p[fits], q[fits]
    yaw = np.arctan2(in_b.base[q, 1], in_b.base[q, 0]) - np.arctan2(in_a.base[p, 1], in_a.base[p, 0])
    x = np.column_stack([np.zeros((len(p), 3)), yaw])
    ends_a, ends_b = a.position[i[p]] + a.position[j[p]], b.position[k[q]] + b.position[n[q]]
    x[:, :3] = (ends_b - move(x, ends_a[:, None])[:, 0]) / 2
    across = problem.spread_a[i[p]] + problem.spread_a[j[p]] + problem.spread_b[k[q]] + problem.spread_b[n[q]]
    support = _support(problem, i[p], k[q], yaw, across / in_a.length[p] ** 2)
    best = np.argsort(-support, kind="stable")
    # Proposals in one cell of a metre and 0.2 rad are one place. Only the best one remains.
    cell = np.round(np.column_stack([x[:, :2], np.mod(yaw, 2 * np.pi) / 0.2]))[best]
    best = best[np.sort(np.unique(cell, axis=0, return_index=True)[1])]
    return i[p[best]], x[best], max(1, round(float(number.sum() * share) / 2))  # Each pair is in the list in both orders.


def _reach(a: Vectors, b: Vectors, size_variance: float) -> Floats:
    """Return by how much (m) the lengths of similar vectors in map b may differ from the lengths (P,) of vectors in map a.

    This difference is at least `_GATE` standard deviations. size_variance: the variance of the logarithm of the size of map
    b. The error of a length in b grows with this length. The length in b is not known yet, but it is hardly more than the
    length in a.
    """
    other = (b.length_variance - size_variance * b.length**2).max(initial=0.0)
    reach = np.zeros_like(a.length)
    for _ in range(2):
        reach = _GATE * np.sqrt(a.length_variance + other + size_variance * (a.length + reach) ** 2)
    return reach


def _support(problem: Problem, i: Ints, k: Ints, yaw: Floats, turn_variance: Floats) -> Floats:
    """Return the number (H,) of neighbours that coincide when an object of map a is laid on an object of map b.

    i, k: (H,) the objects of map a and of map b. Only neighbours with the same label count. yaw, turn_variance: (H,) rad and
    rad^2, the heading of each proposal and its variance.
    """
    (near_a, offset_a), (near_b, offset_b) = (_offsets(m) for m in (problem.a, problem.b))
    support = np.zeros(len(i))
    spread = float(np.median(problem.spread_b))
    size_variance, tilt_variance = (
        sum(of) for of in zip(*((m.size_variance, m.tilt_variance) for m in (problem.a, problem.b)), strict=True)
    )
    size = max(1, _AT_ONCE // (near_a.shape[1] * near_b.shape[1]))
    for begin in range(0, len(i), size):
        h = slice(begin, begin + size)
        a, b = near_a[i[h]], near_b[k[h]]
        turned = offset_a[i[h]] * np.exp(1j * yaw[h])[:, None]
        own = problem.spread_a[i[h]] + problem.spread_b[k[h]]
        far = np.abs(turned) ** 2
        variance = problem.spread_a[a] + spread + own[:, None] + far * (turn_variance[h, None] + size_variance)
        miss = turned[:, :, None] - offset_b[k[h]][:, None, :]
        close = miss.real**2 + miss.imag**2 <= _GATE**2 * variance[:, :, None]
        close &= problem.a.label[a][:, :, None] == problem.b.label[b][:, None, :]
        rise = problem.a.position[a, 2] - problem.a.position[i[h], 2][:, None]
        rise_b = problem.b.position[b, 2] - problem.b.position[k[h], 2][:, None]
        tall = problem.a.own[a, 2, 2] + 2 * np.median(problem.b.own[:, 2, 2]) + far * tilt_variance
        tall += problem.a.own[i[h], 2, 2][:, None]
        close &= (rise[:, :, None] - rise_b[:, None, :]) ** 2 <= _GATE**2 * tall[:, :, None]
        support[h] = close.any(axis=2).sum(axis=1)
    return support


def _offsets(m: Shape) -> tuple[Ints, Array]:
    """Return the neighbours (N, K) of each object, and their horizontal offsets (N, K) from it as x + iy, m."""
    plane = m.position[:, 0] + 1j * m.position[:, 1]
    near = around(m, np.arange(len(plane)), _NEIGHBOURS + 1)[:, 1:]
    return near, plane[near] - plane[:, None]


def around(m: Shape, index: Ints, size: int) -> Ints:
    """Return for each object `index` (H,) the `size` objects nearest to it, itself first."""
    at = m.position[:, :2]
    return np.asarray(KDTree(at).query(at[index], k=np.arange(1, min(size, len(at)) + 1))[1])
