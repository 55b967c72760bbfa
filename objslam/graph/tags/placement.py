"""Place fiducials at given camera poses, and compare the two poses that a flat square leaves open."""

from dataclasses import dataclass

import numpy as np

from objslam.core.arrays import Bools, Floats, Ints
from objslam.core.geometry import make_pose
from objslam.core.rotation import rotation_vector
from objslam.graph.tags.shapes import squares_of
from objslam.graph.tags.square_fit import Corners, Squares, costs, fit, mirrored, poses_of_views, stacked

_CANDIDATES = 8
"""The largest number of views of a fiducial whose two poses are tried. Half of them are the nearest views, and the others
are spread over time. A larger number is slower, and finds the pose more often if many views are false."""
_VIEWS = 64
"""The largest number of views on which a pose of a fiducial is judged. They are spread over time. A larger number is slower
and judges better."""
_STEPS, _STEPS_LAST = 6, 15
"""The numbers of iterations of a fit to one view, and of the last fit. Larger numbers are slower. Both fits usually converge
in five iterations."""
_TOLD = 4.0
"""A fiducial of unknown size gets a pose only if the information about the logarithm of its side exceeds this value. The
value is 1 / 0.5^2. With a larger value, fewer such fiducials get a pose."""
_SAME = np.radians(3.0)
"""The largest angle (rad) between two poses that count as one. With a larger angle, more fiducials have a single pose."""
_CLEARLY = 1.0
"""The decrease of the cost (a robust sum of squared deviations) above which a fiducial is moved to a new pose. A decrease by
1 means odds of e^(1/2). A larger value leaves more fiducials where they are."""


@dataclass(frozen=True)
class Placement:
    """The best pose of each of T fiducials for given camera poses, and a second pose.

    best, other: the squares at the two poses. cost, other_cost: (T,) the costs of the poses by Cauchy's loss, infinite for a
    fiducial without that pose. information: (T, 7, 7) about the best pose, as in `square_fit.fit`.
    """

    best: Squares
    other: Squares
    cost: Floats
    other_cost: Floats
    information: Floats


def place(seen: Corners, shapes: Floats, sides: Floats) -> Placement:
    """Return the best pose of each of T fiducials, and its second pose.

    A single view gives two poses. The two poses of each of `_CANDIDATES` views are tried in `_VIEWS` views. The best pose is
    fitted to the `_VIEWS` views. The mirror image of the best pose is also fitted, because both poses fit if the views have
    little parallax. An unknown side comes from the parallax of the views.

    seen: views of the fiducials. shapes: (T, 4, 3). sides: (T,) m, NaN if unknown.
    """
    count = len(sides)
    judged = seen.take(_spread(seen, _VIEWS))
    views = np.union1d(_nearest(seen, _CANDIDATES // 2), _spread(seen, _CANDIDATES // 2))
    tried = seen.take(views)
    with_both = np.concatenate([views, views])
    squares = poses_of_views(tried, shapes[tried.square], _STEPS)
    owner = seen.square[with_both]
    of_each = _views_of_each(owner, judged, count)
    at = seen.origin[with_both]
    side = np.where(np.isfinite(sides), sides, 1.0)[owner]
    free = ~np.isfinite(sides)
    if free.any():
        side = np.where(free[owner], _side_of_parallax(squares, at, of_each), side)
    squares = _scaled(squares, side, at)
    cost = np.where(np.isfinite(side), costs(of_each, _finite(squares)), np.inf)
    order = np.lexsort((cost, owner))
    best = order[np.searchsorted(owner[order], np.arange(count))]
    found = np.isfinite(cost[best])
    first, first_cost, information = fit(judged, _finite(squares.take(best)), free, _STEPS_LAST)
    start = mirrored(first, at[best])
    second, second_cost, second_information = fit(judged, start, free, _STEPS_LAST)
    found &= ~free | (information[:, 6, 6] > _TOLD)
    between = np.swapaxes(first.pose[:, :3, :3], 1, 2) @ second.pose[:, :3, :3]
    differ = np.linalg.norm(rotation_vector(between), axis=1) > _SAME
    swap = differ & (second_cost < first_cost)
    pair, pair_cost = stacked(first, second), np.concatenate([first_cost, second_cost])
    index = np.arange(count)
    one, two = index + count * swap, index + count * ~swap
    return Placement(
        best=pair.take(one),
        other=pair.take(two),
        cost=np.where(found, pair_cost[one], np.inf),
        other_cost=np.where(found & differ, pair_cost[two], np.inf),
        information=np.where(swap[:, None, None], second_information, information),
    )


def placed(seen: Corners, shapes: Floats, sides: Floats, landmarks: Ints, positions: Floats) -> Floats:
    """Return the positions (M, 3) m of landmarks, with the corners of each fiducial at its best pose.

    A fiducial whose corners already form a square is not moved, unless another pose is better. The corners of a fiducial
    without a pose become NaN, so that they are in no graph. landmarks: (T, 4) of each fiducial.
    """
    found = place(seen, shapes, sides)
    corners = np.where(np.isfinite(found.cost)[:, None, None], found.best.corners, np.nan)
    known = np.isfinite(positions[landmarks]).all(axis=(1, 2)) & np.isfinite(found.cost)
    if known.any():
        rotation, centre, size = squares_of(np.where(known[:, None, None], positions[landmarks], shapes), shapes)
        now = Squares(shapes, make_pose(rotation, centre), np.where(np.isfinite(sides), sides, size))
        better = costs(seen.take(_spread(seen, _VIEWS)), now) > found.cost + _CLEARLY
        corners = np.where((known & ~better)[:, None, None], now.corners, corners)
    placed = positions.copy()
    placed[landmarks] = corners
    return placed


def _spread(seen: Corners, most: int) -> Ints:
    """Return at most `most` views of each square, spread evenly over all views of the square."""
    number = np.bincount(seen.square)[seen.square]
    order = np.argsort(seen.square, kind="stable")
    begin = np.searchsorted(seen.square[order], seen.square[order])
    rank = np.empty(len(seen), dtype=np.int64)
    rank[order] = np.arange(len(seen)) - begin
    kept: Bools = (rank * most) // np.maximum(number, most) != ((rank - 1) * most) // np.maximum(number, most)
    return np.flatnonzero(kept | (rank == 0))


def _nearest(seen: Corners, most: int) -> Ints:
    """Return the views in which each square looks largest, at most `most` of each."""
    across = np.linalg.norm(seen.direction[:, 2] - seen.direction[:, 0], axis=1)
    order = np.lexsort((-across, seen.square))
    rank = np.arange(len(seen)) - np.searchsorted(seen.square[order], seen.square[order])
    return np.sort(order[rank < most])


def _views_of_each(owner: Ints, judges: Corners, count: int) -> Corners:
    """Return for each candidate a copy of the views of its fiducial. judges: the views, of `count` fiducials. owner: (C,)
    the fiducial of each candidate."""
    judges = judges.take(np.argsort(judges.square, kind="stable"))
    begin, number = np.searchsorted(judges.square, np.arange(count)), np.bincount(judges.square, minlength=count)
    candidate = np.repeat(np.arange(len(owner)), number[owner])
    offset = np.arange(len(candidate)) - np.repeat(np.cumsum(number[owner]) - number[owner], number[owner])
    view = begin[owner[candidate]] + offset
    return Corners(candidate, judges.origin[view], judges.direction[view], judges.sigma[view], judges.whitening[view])


def _side_of_parallax(squares: Squares, origins: Floats, seen: Corners) -> Floats:
    """Return the side (H,) m at which squares of side 1, scaled about `origins` (H, 3) m, fit the views best.

    The fit is by least squares of the distances from the rays. A side is NaN if the views do not determine it.
    """
    by_side = (squares.corners - origins[:, None])[seen.square]
    away = (seen.origin - origins[seen.square])[:, None]
    across = np.eye(3) - seen.direction[..., :, None] * seen.direction[..., None, :]
    by_side, away = np.einsum("vcij,vcj->vci", across, by_side), np.einsum("vcij,vcj->vci", across, away + 0 * by_side)
    count = len(squares.side)
    product, square = (np.bincount(seen.square, (by_side * other).sum(axis=(1, 2)), count) for other in (away, by_side))
    side = product / np.maximum(square, 1e-12)
    return np.where(side > 0, side, np.nan)


def _scaled(squares: Squares, side: Floats, origins: Floats) -> Squares:
    """Return squares of side 1 after a scaling to sides (H,) m. The scaling leaves the points `origins` (H, 3) m where they
    are."""
    pose = squares.pose.copy()
    pose[:, :3, 3] = origins + side[:, None] * (pose[:, :3, 3] - origins)
    return Squares(squares.shape, pose, side)


def _finite(squares: Squares) -> Squares:
    """Return the squares. A square with an unknown side is replaced by a square of side 1 at the identity."""
    known = np.isfinite(squares.side)
    pose = np.where(known[:, None, None], squares.pose, np.eye(4))
    return Squares(squares.shape, pose, np.where(known, squares.side, 1.0))
