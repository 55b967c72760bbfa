"""Estimate the errors that the boxes of a body share, and weigh the boxes accordingly.

A side of an object is a direction from which it is seen. All boxes from one side err alike, because the outline of the
object is no ellipse, and because detectors err systematically. Averaging does not reduce this error, so the boxes of a side
count as few (Kish 1965).
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from objslam.core.arrays import Bools, Floats, Ints
from objslam.core.geometry import evenly_spread
from objslam.core.statistics import NORMAL_MEDIAN
from objslam.triangulation.bodies.edges import BoxEdges
from objslam.triangulation.bodies.fit import Fit, Weights, grouped
from objslam.triangulation.bodies.residuals import ROWS, Residuals, at_edges, nominal_noise, on_shift_and_size, whole_axes

SIDES = 103
"""The number of sides from which an object can be seen. They are spread evenly over the sphere, 20 degrees apart. The boxes
from one side share an error. A larger number makes narrower sides, and is slower."""
ALIKE = np.radians(20.0)
"""The angle (rad) between two views of an object over which the correlation of their shared errors falls to 1/2. With a
larger angle, views must differ more to average the errors out. A detector had 5 to 20 degrees on three objects of
YCB-Video."""
WITHIN = 0.7
"""The correlation between the shared errors of two boxes from one side. The directions of two such boxes differ by 10
degrees on average. So the variance of the mean error of a side is this share of the variance of a single error. With a
larger share, the estimate of the errors is smaller."""
UNLIKE = 0.04
"""The least standard deviation of the error that the boxes of one side share, as a share of half the size. Boxes share an
error because no thing has exactly the shape of its body. The outlines of a hexagonal prism and of the best cylinder differ
by 4 %. Things that were seen from one side do not show this error, because their bodies bend to it. A larger share makes
their depths less sure."""
_ALONG = 1.0
"""The standard deviation of the change in the error of a side if the distance grows by a factor of e, in standard deviations
of the error. With a larger change, the growth of boxes says less about the distance."""
BEYOND = 0.5
"""The root mean square of the hidden length beyond an edge that is a bound, as a share of the size of the box. Lengths that
are evenly spread between 0 and 0.9 of the size have this root mean square. A larger share makes partly hidden objects less
sure."""
_SHARES = 41
"""The number of shares that `share_of` tries, from 0 to `_WIDEST` times the prior. A larger number is more exact and slower.
"""
_WIDEST = 6.0
"""The largest share that `share_of` tries, as a multiple of the scale of its prior. A larger value admits worse outlines."""
_UNLIKE_OTHERS = 0.01
"""The prior chance that a body has another share than the other bodies, because some of its boxes show another thing. This
limits how much one body counts. Without this chance, ten wrong boxes at one of 45 doors made the share 0.3 instead of 0.03,
and then no door showed that it is flat. With a larger chance, each body counts less. With 0.1, the share from a few bodies
is too small."""
_AT_ONCE = 64
"""The most bodies whose likelihoods `share_of` computes at once. A larger number needs more memory."""
_NOMINAL = 20.0
"""The weight of the nominal noise of the settings against the scatter of the residuals, as half the number of residuals. A
larger number gives the nominal noise more weight."""


@dataclass(frozen=True)
class Sides:
    """The C sides from which N bodies were seen in B boxes.

    cell: (B,) the side of each box. owner: (C,) the body of each side. alike: for each body, the correlations (c, c) between
    the errors of its c sides. number: (B, 4) the number of boxes that share the error of each shift and size, weighted by
    the correlation.
    """

    cell: Ints
    owner: Ints
    alike: tuple[Floats, ...]
    number: Floats


def sides_of(edges: BoxEdges, centre: Floats, use: Floats | None = None) -> Sides:
    """Return the sides of bodies with centres (N, 3), m, in map. use: (B, 4) whether a residual counts, None if all
    count."""
    towards = centre[edges.body] - edges.origin
    towards = towards / np.linalg.norm(towards, axis=1, keepdims=True)
    seen = edges.body * SIDES + (towards @ evenly_spread(SIDES).T).argmax(axis=1)
    boxes = np.bincount(seen, minlength=len(centre) * SIDES)
    there = np.flatnonzero(boxes)
    owner, cell = there // SIDES, (np.cumsum(boxes > 0) - 1)[seen]
    if use is None:
        number = np.repeat(boxes[there, None], ROWS - 1, axis=1).astype(np.float64)
    else:
        number = np.stack([np.bincount(cell, part) for part in use.T], axis=1).astype(np.float64)
    mean = np.stack([np.bincount(cell, part) for part in towards.T], axis=1)
    mean = mean / np.linalg.norm(mean, axis=1, keepdims=True)
    shared, alike = number.copy(), [np.zeros((0, 0))] * len(centre)
    many = np.bincount(owner, minlength=len(centre))
    begin = np.cumsum(many) - many
    for sides in np.unique(many).tolist():  # Bodies with equal numbers of sides are one array.
        which = np.flatnonzero(many == sides)
        mine = begin[which, None] + np.arange(sides)
        angle = np.arccos(np.clip(mean[mine] @ np.swapaxes(mean[mine], 1, 2), -1, 1))
        found = WITHIN * 0.5 ** (angle / ALIKE)
        shared[mine] = found @ number[mine]
        for body, one in zip(which.tolist(), found, strict=True):
            alike[body] = one
    return Sides(cell, owner, tuple(alike), shared[cell])


def some_of_each_side(sides: Sides, most: int) -> Ints:
    """Return the indices, increasing, of at most `most` boxes of each side, evenly chosen in the order of the boxes."""
    order = np.argsort(sides.cell, kind="stable")
    number = np.bincount(sides.cell)
    rank = np.empty(len(order), dtype=np.int64)
    rank[order] = np.arange(len(order)) - (np.cumsum(number) - number)[sides.cell[order]]
    total = number[sides.cell]
    kept = np.minimum(total, most)
    return np.flatnonzero((rank * kept) // total != ((rank - 1) * kept) // total)


def white_factors(edges: BoxEdges, now: Residuals, sides: Sides, which: Bools) -> Floats:
    """Return the factors (2,) on the nominal noise of shifts and of sizes, from the scatter of boxes within a side.

    now: the residuals of the boxes. which: (B,) a mask of the boxes that count.
    """
    whole, sigma = whole_axes(edges), nominal_noise(edges)
    number = np.stack([np.bincount(sides.cell, part) for part in whole.T], axis=1)
    free = np.sqrt(1 - 1 / np.maximum(number, 1))[sides.cell]
    factors = np.ones(2)
    for kind, rows in enumerate((slice(0, 2), slice(2, 4))):
        deviation = np.where(whole[:, rows], now.value[:, rows] / sigma[:, rows], 0.0)
        total = np.stack([np.bincount(sides.cell, part) for part in deviation.T], axis=1)
        mean = total / np.maximum(number[:, rows], 1)
        some = which[:, None] & (number[sides.cell, rows] > 1) & whole[:, rows]
        off = np.abs(deviation - mean[sides.cell])[some] / free[:, rows][some]
        if len(off):
            found = (np.median(off) / NORMAL_MEDIAN) ** 2
            factors[kind] = np.sqrt((len(off) / 2 * found + _NOMINAL) / (len(off) / 2 + _NOMINAL))
    return factors


def spread_of(edges: BoxEdges, factors: Floats, share: Floats) -> Floats:
    """Return the standard deviations (B, 5) of residuals, from their independent noise and their shared error."""
    return at_edges(edges, np.hypot(_white(edges, factors), _scale(edges, share)))


def weights_of(edges: BoxEdges, number: Floats, factors: Floats, share: Floats) -> Weights:
    """Return how much the residuals count, so that the shared error of a side counts once.

    number: (B, 4) as in `Sides`. factors, share: (2,) as in `Bodies`.
    """
    ranged = np.bincount(edges.body, np.isfinite(edges.range))  # All ranges of a body share their error.
    number = np.column_stack([number, ranged[edges.body]])
    own, shared = at_edges(edges, _white(edges, factors)), at_edges(edges, _scale(edges, share))
    return Weights(own**2 + number * shared**2, np.hypot(own, shared))


def _white(edges: BoxEdges, factors: Floats) -> Floats:
    """Return the standard deviations (B, 5) of the independent errors of shift, size and range."""
    sigma = nominal_noise(edges)
    return np.concatenate([sigma[:, :4] * np.repeat(factors, 2), sigma[:, 4:]], axis=1)


def _scale(edges: BoxEdges, share: Floats) -> Floats:
    """Return the standard deviations (B, 5) of the errors that boxes share: a share of their size, px, or of the range."""
    return np.concatenate([np.outer(edges.size / 2, np.repeat(share, 2)), edges.range_bias[:, None]], axis=1)


def share_of(edges: BoxEdges, fit: Fit, sides: Sides, factors: Floats, prior: float, which: Bools) -> Floats:
    """Return the standard deviations (2,) of the errors that the boxes of one side share, as shares of half their size.

    The first share is that of the shifts of boxes, and the second that of their sizes. Each is the root mean square of its
    posterior. Because the bodies are unknown, the likelihood is the restricted one (Patterson and Thompson 1971). The prior
    is half-normal (Gelman 2006), with the scale `prior`. A body may differ from the others (`_UNLIKE_OTHERS`). which: (N,) a
    mask of the bodies that count.
    """
    shares = np.linspace(0.0, _WIDEST * prior, _SHARES)
    likelihood = np.tile(-0.5 * (shares / prior) ** 2, (2, 1))
    white, size = at_edges(edges, _white(edges, factors))[:, :4], edges.size / 2
    weight = (fit.weight[:, :4] > 0) & whole_axes(edges)
    total = np.stack([np.bincount(sides.cell, w) for w in (weight / white**2).T], axis=1)
    total = np.maximum(total, 1e-12)
    mean, scale = (
        np.stack([np.bincount(sides.cell, w * part) for w, part in zip((weight / white**2).T, parts, strict=True)], axis=1)
        / total
        for parts in (fit.found.value[:, :4].T, np.repeat(size[None], 4, axis=0))
    )
    by = grouped(sides.cell, (weight / white**2)[..., None] * fit.found.by[:, :4], len(sides.owner)) / total[..., None]
    bounds = np.searchsorted(sides.owner, np.arange(len(fit.values) + 1))
    number = np.diff(bounds)
    told = np.flatnonzero(which & (number > 1))
    for begin in range(0, len(told), _AT_ONCE):
        some = told[begin : begin + _AT_ONCE]
        # A body with fewer sides gets more sides that measure nothing, so that the arrays of all bodies have one shape.
        most = int(number[some].max())
        cell = bounds[some, None] + np.arange(most)
        real = np.arange(most) < number[some, None]
        cell = np.where(real, cell, 0)
        root = np.sqrt(total[cell]) * real[..., None]  # (n, c, 4)
        alike = np.zeros((len(some), most, most))
        for at, body in enumerate(some.tolist()):
            alike[at, : number[body], : number[body]] = sides.alike[body]
        part = np.swapaxes(scale[cell] * root, 1, 2)  # (n, 4, c)
        eigen, vectors = np.linalg.eigh(part[..., :, None] * alike[:, None] * part[..., None, :])
        turn = np.swapaxes(vectors, 2, 3)
        value = (turn @ np.swapaxes(mean[cell] * root, 1, 2)[..., None])[..., 0]
        slope = turn @ np.swapaxes(by[cell] * root[..., None], 1, 2)  # (n, 4, c, 7)
        for kind in range(2):  # The first two rows are shifts.
            rows = slice(2 * kind, 2 * kind + 2)
            off, lean, wide = (
                one[:, rows].reshape(len(some), 2 * most, *one.shape[3:]) for one in (value, slope, np.maximum(eigen, 0.0))
            )
            variance = 1 + shares[:, None] ** 2 * wide[:, None]  # (n, s, 2 c)
            square = (lean[..., :, None] * lean[..., None, :]).reshape(len(some), 2 * most, -1)
            matrix = (1 / variance @ square).reshape(len(some), _SHARES, *fit.prior.shape[1:]) + fit.prior[some, None]
            vector = 1 / variance @ (lean * off[..., None])
            explained = (vector * np.linalg.solve(matrix, vector[..., None])[..., 0]).sum(axis=2)
            squares = (off[:, None] ** 2 / variance + np.log(variance)).sum(axis=2)
            own = -0.5 * (squares + np.linalg.slogdet(matrix)[1] - explained)  # (n, s)
            own -= own.max(axis=1, keepdims=True)
            likelihood[kind] += np.log((1 - _UNLIKE_OTHERS) * np.exp(own) + _UNLIKE_OTHERS).sum(axis=0)
    chance = np.exp(likelihood - likelihood.max(axis=1, keepdims=True))
    return np.asarray(np.sqrt((chance * shares**2).sum(axis=1) / chance.sum(axis=1)))


def covariance_of(edges: BoxEdges, fit: Fit, sides: Sides, factors: Floats, share: Floats) -> Floats:
    """Return the covariances (N, 7, 7) of the parameters of bodies, with the errors that their boxes share.

    If W are the weights of the residuals, the covariance is A^-1 (J^T W V W J + P) A^-1, where A = J^T W J + P. J are the
    derivatives of the residuals, V is their true covariance, and P is the information of the prior.
    """
    return covariance_with_unlike(edges, fit, sides, factors, share)[0]


def covariance_with_unlike(edges: BoxEdges, fit: Fit, sides: Sides, factors: Floats, share: Floats) -> tuple[Floats, Floats]:
    """Return the covariances (N, 7, 7) of `covariance_of`, and covariances (N, 7, 7) to be added to them (`UNLIKE`).

    The second ones allow for the fact that no thing has exactly the shape of its body. The error of a side is not the same
    from all distances. If it were the same, the growth of boxes on the way to a thing would give the distance of the thing
    exactly, however wrong its outline is.
    """
    count = len(fit.values)
    loose = np.zeros((len(edges), ROWS))
    loose[:, : ROWS - 1] = _weights_of_bounds(edges, fit.found)
    weighted = fit.found.by * np.where(loose > 0, 0.0, fit.weight)[..., None]
    pulled = on_shift_and_size(edges, weighted)
    noisy = pulled * _white(edges, factors)[..., None]
    of_bounds = grouped(edges.body, np.swapaxes(fit.found.by, 1, 2) @ (fit.found.by * loose[..., None]), count)
    middle = grouped(edges.body, np.swapaxes(noisy, 1, 2) @ noisy, count) + fit.prior + of_bounds
    together = pulled * _scale(edges, np.ones(2))[..., None]
    by_side = grouped(sides.cell, together, len(sides.owner))
    change = _ALONG * _ln_distances(edges, fit)[:, None, None] * together[:, : ROWS - 1]
    change = grouped(edges.body, change, count)
    of_rows = change[..., :, None] * change[..., None, :]  # (N, 4, 7, 7), for a share of 1 in each row.
    bounds = np.searchsorted(sides.owner, np.arange(count + 1))
    for body, (begin, end) in enumerate(pairwise(bounds.tolist())):
        mine = np.swapaxes(by_side[begin:end], 0, 1)
        of_rows[body] += np.swapaxes(mine[:-1], 1, 2) @ (sides.alike[body] @ mine[:-1])
        middle[body] += np.outer(*[mine[-1].sum(axis=0)] * 2)
    each, unlike = np.repeat(share**2, 2), np.repeat(np.maximum(UNLIKE**2 - share**2, 0.0), 2)
    middle += np.einsum("r,nrij->nij", each, of_rows)
    information = grouped(edges.body, np.swapaxes(weighted, 1, 2) @ fit.found.by, count) + fit.prior + of_bounds
    inverse = np.linalg.inv(information)
    found = inverse @ np.stack([middle, np.einsum("r,nrij->nij", unlike, of_rows)]) @ inverse
    told, more = (found + np.swapaxes(found, 2, 3)) / 2
    return told, more


def _weights_of_bounds(edges: BoxEdges, found: Residuals) -> Floats:
    """Return the weights (B, 4), 1/px^2, with which bounds count in a covariance, 0 for residuals that are no bounds.

    A body that just reaches a bound may go on beyond it, by a hidden length. So a bound counts like a measured edge whose
    error has this length, at least `BEYOND` times the size of the box. All boxes of a body share this error, so together
    they count as one.
    """
    length = np.hypot(BEYOND * np.maximum(edges.size, 1.0)[:, None], np.maximum(found.value[:, : ROWS - 1], 0.0))
    number = np.bincount(edges.body)[edges.body, None]
    return np.asarray(edges.bound / (number * length**2))


def _ln_distances(edges: BoxEdges, fit: Fit) -> Floats:
    """Return ln of the distance (B,) of each box's camera from its body, minus the mean over the boxes of the body."""
    away = np.linalg.norm(fit.values[edges.body, :3] - edges.origin, axis=1)
    found = np.log(np.maximum(away, 1e-9))
    number = np.maximum(np.bincount(edges.body, minlength=len(fit.values)), 1)
    return np.asarray(found - (np.bincount(edges.body, found, len(fit.values)) / number)[edges.body])
