"""Drop objects that are only the visible part of another object.

If leaves hide the top of a post from one side, the post has boxes of two heights: boxes of the whole post, and boxes of its
visible part. The rays through the centres of the two kinds of boxes meet in two points above each other, so association
makes two objects. But two things of one label cannot fill one space."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from objslam.association.duplicates import near_pairs, seen_as_two
from objslam.core.arrays import Bools, Floats, Ints
from objslam.core.geometry import lengths
from objslam.mapping.moves.moving_things import without_things
from objslam.mapping.solution import Solution

_BEYOND = 0.1
"""The largest distance by which a part may end above or below its thing, as a share of the height of the thing. Boxes show
the ends of a thing to a few percent. With a larger share, more objects are dropped."""
_BOXES = 0.25
"""The fewest boxes of the thing, as a share of the boxes of its part. A false object with few boxes may have a large body,
which must not take in a right object. With a larger share, fewer objects are dropped."""


def without_visible_parts(solution: Solution) -> Solution:
    """Return a solution with bodies without the objects that are a visible part of another object of their label.

    The part stands where the other object stands, to within the length of the body. It ends neither above nor below the
    other body. Hardly any frame shows both objects. The rays of dropped objects belong to no
    object.
    """
    estimate, association, bodies = solution.estimate, solution.association, solution.bodies
    if bodies is None:
        return solution
    known = np.array([j for j, one in enumerate(bodies) if one is not None and estimate.solved[j]], dtype=np.int64)
    if len(known) < 2:
        return solution
    ends, place, length, spread = _measured(solution, known)
    a, b, apart = near_pairs(place, association.label[known], 2 * float(length.max()))
    higher = np.diff(ends, axis=1)[:, 0]
    number = np.bincount(association.object[association.object >= 0], minlength=association.count)[known]
    swap = higher[a] < higher[b]
    thing, part = np.where(swap, b, a), np.where(swap, a, b)
    slack = _BEYOND * higher[thing]
    inside = (ends[part, 0] >= ends[thing, 0] - slack) & (ends[part, 1] <= ends[thing, 1] + slack)
    # A wide sigma must not reach a neighbour, so the noise counts up to half of the length.
    reach = (length[thing] + np.minimum(length[thing], 2 * np.hypot(spread[a], spread[b]))) / 2
    likely = np.flatnonzero(inside & (lengths(apart) <= reach) & (number[thing] >= _BOXES * number[part]))
    gone = np.zeros(association.count, dtype=bool)
    for i, j in zip(known[thing[likely]].tolist(), known[part[likely]].tolist(), strict=True):
        gone[j] |= not _are_two(solution, i, j)
    return _without(solution, gone) if gone.any() else solution


def _measured(solution: Solution, known: Ints) -> tuple[Floats, Floats, Floats, Floats]:
    """Return the lower and upper ends (N, 2) m, the places (N, 3) m at height 0, the lengths (N,) m of bodies, and the
    standard deviation (N,) m of each place in one horizontal direction. known: (N,) the objects of the bodies."""
    estimate = solution.estimate
    bodies = [body for j in known.tolist() if (body := (solution.bodies or ())[j]) is not None]
    points = estimate.positions[known]
    centre = np.array([point if body.centre is None else body.centre for point, body in zip(points, bodies, strict=True)])
    size = np.array([body.body.size for body in bodies])
    ends = centre[:, 2:] + size[:, 2:] / 2 * [-1.0, 1.0]
    spread = np.sqrt(np.trace(estimate.covariance[known][:, :2, :2], axis1=1, axis2=2) / 2)
    return ends, centre * [1.0, 1.0, 0.0], size[:, 0], np.nan_to_num(spread)


def _are_two(solution: Solution, one: int, other: int) -> bool:
    """Return whether so many frames have boxes of both objects that they are two things."""
    first, second = (np.unique(solution.rays.keyframe[solution.association.object == j]) for j in (one, other))
    return seen_as_two(len(np.intersect1d(first, second)), min(len(first), len(second)))


def _without(solution: Solution, gone: Bools) -> Solution:
    """Return the solution without the objects in a mask (N,)."""
    left = without_things(solution.association, gone)
    bodies = tuple(body for body, drop in zip(solution.bodies or (), gone.tolist(), strict=True) if not drop)
    estimate = solution.estimate.of_objects(~gone, left.object >= 0)
    return replace(solution, association=left, estimate=estimate, bodies=bodies)
