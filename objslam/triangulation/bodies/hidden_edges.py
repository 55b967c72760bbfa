"""Find the edges of boxes beyond which something hides a part of the object. They are called hidden edges.

A box goes around the visible part of an object. So if something hides a part, the box ends short of the body. An edge that
ends short by more than the noise may be hidden. A hidden edge is a bound, like an edge at the image's border. An edge that
reaches too far does not count as hidden.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from objslam.core.arrays import Bools, Floats, Ints
from objslam.triangulation.bodies.choice import log_evidence
from objslam.triangulation.bodies.edges import BOTTOM, TOP, BoxEdges
from objslam.triangulation.bodies.fit import ENOUGH, STEPS, Prior, fit, grouped
from objslam.triangulation.bodies.prior import cuboid_prior
from objslam.triangulation.bodies.residuals import beyond_edges
from objslam.triangulation.bodies.shapes import CUBOID, KINDS, Kind
from objslam.triangulation.bodies.shared import BEYOND, sides_of, spread_of, weights_of

_OUTER = 0.05
"""The share of its usual weight with which an edge counts if the outer body (see `hidden_edges`) reaches beyond it. With a
smaller share, the outer body grows around the noise of more edges. With a larger share, hidden edges make the outer body too
small."""
_CLEAR = 2.0
"""The number of standard deviations by which a body must reach beyond an edge that may be hidden. The evidence decides
whether the edge is hidden. With a larger number, bodies still bend to some hidden edges. With a smaller number, noise makes
more visible edges count as hidden."""
_UNSEEN = 0.5
"""The share of the bounds at an end of a body above which the end is unseen, if the body just reaches them. If other edges
show the end, the bounds lie inside the body. With a larger share, fewer ends are unseen."""
_FEW_BOUNDS = 0.4
"""The least share of a body's boxes that have bounds at an unseen end. With fewer bounds, other boxes may show the end:
things that only touch in the image have bounds too. With 0.2, large things whose depths show the scale of a map lost 16 % of
the exactness of this scale. With 0.5, 5 more of 38 desks behind chairs were outside their 95 % ellipsoid. With a larger
share, fewer ends are unseen."""
_TURNS = 5
"""The most turns of finding the hidden edges and fitting the body without them. Two to four turns are usual. More turns are
slower."""


@dataclass(frozen=True)
class Hidden:
    """The hidden edges of N bodies.

    edges: (B, 4) a mask of the hidden edges. between: (N, 6, 6) m^2, the uncertainty of centre and half axes because it is
    unknown whether edges are hidden. It is the second moment of centre and half axes about those of the likelier body.
    """

    edges: Bools
    between: Floats


@dataclass(frozen=True)
class Noise:
    """The noise of B boxes.

    factors, share: as in `Bodies`. number: (B, 4) as in `Sides`. side: (B,) px, as in `log_evidence`.
    """

    factors: Floats
    share: Floats
    number: Floats
    side: Floats

    def take(self, boxes: Ints) -> Noise:
        """Select boxes."""
        return replace(self, number=self.number[boxes], side=self.side[boxes])


def with_hidden(edges: BoxEdges, hidden: Bools) -> BoxEdges:
    """Return the edges, with those in the mask `hidden` (B, 4) as further bounds."""
    return replace(edges, bound=edges.bound | hidden)


def hidden_edges(
    edges: BoxEdges, some: Ints, start: Floats, shape: Ints, prior: Prior, side: Floats, factors: Floats, share: Floats
) -> Hidden:
    """Return the hidden edges. An object has hidden edges only if they explain its boxes better than a body that bends to
    fit all edges.

    A body that is fitted to all edges bends to the hidden ones, so that no edge stands out. So an outer body is fitted,
    which may reach beyond edges at little cost. Edges far inside this body are taken to be hidden, and a body is fitted
    without them. These two steps repeat in turns. The evidence decides between the result and the body of all edges. Before
    the fits, both are equally probable.

    some: the indices of the boxes that the fits use. start: (N, 7) the bodies. shape: (N,) their shapes. prior: the prior of
    ellipsoids. side: (B,) px, as in `log_evidence`. factors, share: as in `Bodies`.
    """
    found = Hidden(np.zeros((len(edges), 4), dtype=bool), np.zeros((len(start), 6, 6)))
    chosen = np.zeros(len(edges), dtype=bool)
    chosen[some] = True
    for number in np.unique(shape).tolist():
        mine = np.flatnonzero(shape == number)
        at = np.flatnonzero(np.isin(edges.body, mine))
        own = _of_bodies(edges, at, mine)
        few = np.flatnonzero(chosen[at])
        loose = Prior(prior.mean[mine], prior.information[mine])
        if KINDS[number] is CUBOID:
            loose = cuboid_prior(loose, start[mine])
        # The bodies move little in the fits, so the sides of their boxes stay the same.
        noise = Noise(factors, share, sides_of(own.take(few), start[mine, :3]).number, side[at[few]])
        one = _of_kind(own, few, start[mine], KINDS[number], loose, noise)
        found.edges[at], found.between[mine] = one.edges, one.between
    return found


def unseen_ends(edges: BoxEdges, values: Floats, shape: Ints, factors: Floats, share: Floats) -> Floats:
    """Return the uncertainty (N, 6, 6), m^2, of centres and half axes because no box shows where bodies (N, 7) end.

    If a thing in front hides one end of a thing in all views, the body ends where its visible part ends. The edges there are
    bounds that the body just reaches. Edges of other boxes at the same end prove nothing, because something without a box
    may hide them. The end may be farther out by the hidden length (`BEYOND`). Half of this length moves the centre. shape:
    (N,). factors, share: as in `Bodies`.
    """
    found = np.zeros((len(values), 6, 6))
    number = np.maximum(np.bincount(edges.body, minlength=len(values)), 1)
    for one in np.unique(shape).tolist():
        at = np.flatnonzero((shape == one)[edges.body])
        some, kind = edges.take(at), KINDS[one]
        bound = np.asarray(some.bound >= 1)
        bare = replace(some, bound=np.ones_like(some.bound))
        reached = bound & (beyond_edges(some, values, kind) <= _CLEAR * spread_of(bare, factors, share)[:, :4])
        away = np.linalg.norm(values[some.body, :3] - some.origin, axis=1)
        for edge in range(4):
            bounds, touched = (np.bincount(some.body, part[:, edge], len(values)) for part in (bound, reached))
            unseen = (touched > _UNSEEN * bounds) & (bounds >= _FEW_BOUNDS * number)
            length = BEYOND * some.size * some.turn[:, edge] * away
            # The means over the reached bounds.
            weight = reached[:, edge] / np.maximum(touched, 1)[some.body]
            half = np.bincount(some.body, weight * length, len(values)) / 2
            outward = grouped(some.body, weight[:, None] * some.normal[:, edge], len(values))
            for moved in _moved(outward, kind.heading(values), upright=edge in (TOP, BOTTOM)):
                moved = (unseen * half)[:, None] * moved
                found += moved[:, :, None] * moved[:, None, :]
    return found


def _moved(outward: Floats, yaw: Floats, *, upright: bool) -> Iterator[Floats]:
    """Yield the changes (N, 6) of centres and half axes of bodies if a hidden end lies 2 m farther out.

    A hidden top or bottom lies farther up or down. A hidden side lies farther outwards, or the body is moved at right angles
    to that, where the thing in front also hides it. outward: (N, 3) the normals of the bounds. yaw: (N,) rad, the yaw of the
    bodies. upright: whether the end is a top or a bottom.
    """
    none = np.zeros(len(yaw))
    if upright:
        yield np.tile([0.0, 0.0, 1.0, 0.0, 0.0, 1.0], (len(yaw), 1))
        return
    x, y = (outward[:, :2] / np.maximum(np.linalg.norm(outward[:, :2], axis=1), 1e-9)[:, None]).T
    along, across = np.abs(np.cos(yaw) * x + np.sin(yaw) * y), np.abs(np.cos(yaw) * y - np.sin(yaw) * x)
    yield np.stack([x, y, none, along, across, none], axis=1)
    yield np.stack([-y, x, none, none, none, none], axis=1)


def _of_kind(edges: BoxEdges, some: Ints, start: Floats, kind: Kind, prior: Prior, noise: Noise) -> Hidden:
    """Return the hidden edges of bodies of one kind (see `hidden_edges`). noise: the noise of the boxes `some`."""
    found = Hidden(np.zeros((len(edges), 4), dtype=bool), np.zeros((len(start), 6, 6)))
    few = edges.take(some)
    bent, before = _fitted(few, start, kind, prior, noise)
    outer, _ = _fitted(replace(few, bound=np.where(few.bound, 1.0, 1 - _OUTER)), bent, kind, prior, noise)
    mine = np.unique(few.body[_inside(few, outer, kind, noise).any(axis=1)])
    if not len(mine):
        return found
    best, most = outer[mine], np.full(len(mine), -np.inf)
    hidden = np.zeros((len(few), 4), dtype=bool)
    now, moving = outer.copy(), mine
    for _ in range(_TURNS):
        at = np.flatnonzero(np.isin(few.body, moving))
        own = _of_bodies(few, at, moving)
        inside = _inside(own, now[moving], kind, noise)
        # A body whose hidden edges stay as they are would be fitted to the same edges again.
        changed = np.unique(own.body[(inside != hidden[at]).any(axis=1)])
        if not len(changed):
            break
        hidden[at], moving = inside, moving[changed]
        at = np.flatnonzero(np.isin(few.body, moving))
        own = with_hidden(_of_bodies(few, at, moving), hidden[at])
        its_prior = Prior(prior.mean[moving], prior.information[moving])
        now[moving], evidence = _fitted(own, now[moving], kind, its_prior, noise.take(at))
        row = np.searchsorted(mine, moving)
        best[row] = np.where((evidence > most[row])[:, None], now[moving], best[row])
        most[row] = np.maximum(evidence, most[row])
    chance = 1 / (1 + np.exp(-np.clip(most - before[mine], -50, 50)))
    off = _axes(best, kind) - _axes(bent[mine], kind)
    found.between[mine] = np.minimum(chance, 1 - chance)[:, None, None] * off[:, :, None] * off[:, None, :]
    at = np.flatnonzero(np.isin(edges.body, mine[chance > 0.5]))
    found.edges[at] = _inside(_of_bodies(edges, at, mine), best, kind, noise) & ~edges.bound[at]
    return found


def _of_bodies(edges: BoxEdges, boxes: Ints, bodies: Ints) -> BoxEdges:
    """Return some boxes. The body of each box is replaced by its index among the given bodies (sorted numbers)."""
    own = edges.take(boxes)
    return replace(own, body=np.searchsorted(bodies, own.body))


def _fitted(edges: BoxEdges, start: Floats, kind: Kind, prior: Prior, noise: Noise) -> tuple[Floats, Floats]:
    """Return the best bodies (N, 7) of one kind, and the logarithm of their evidence (N,)."""
    weights = weights_of(edges, noise.number, noise.factors, noise.share)
    found = fit(edges, start, prior, weights, kind, still=ENOUGH, most=STEPS)
    return found.values, log_evidence(edges, found, prior, weights, noise.side)


def _inside(edges: BoxEdges, values: Floats, kind: Kind, noise: Noise) -> Bools:
    """Return a mask (B, 4) of the edges that lie clearly inside bodies (N, 7) of one kind."""
    bare = replace(edges, bound=np.ones_like(edges.bound))  # Then the residuals are those of the edges.
    return np.asarray(beyond_edges(edges, values, kind) > _CLEAR * spread_of(bare, noise.factors, noise.share)[:, :4])


def _axes(values: Floats, kind: Kind) -> Floats:
    return np.column_stack([values[:, :3], kind.half_axes(values)])
