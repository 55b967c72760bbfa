"""Flanks of things in a row that their neighbours, or something between them, may hide.

The camera passes a row of things, such as pallets on a rack, and sees their fronts at many angles. If the neighbours or the
uprights of the rack hide the flanks from all of them, the boxes go around the fronts only. The body of such boxes is flat,
as that of a door would be, and nothing else tells the two apart.
"""

from __future__ import annotations

import numpy as np

from objslam.core.arrays import Bools, Floats
from objslam.core.geometry import nearest_points
from objslam.triangulation.bodies.edges import BoxEdges
from objslam.triangulation.bodies.fit import grouped

_PROBABILITY = 0.5
"""The probability that a flat body in a row has hidden flanks. Boxes say nothing about it, so both are equally probable. A
larger value makes the centres of flat things in rows less sure."""
_FLAT = 0.5
"""A body is flat if its depth is less than this share of its width. Bodies of simulated fronts had up to 0.45, and things
that showed their flanks seldom less than 0.6. With a larger share, more bodies are flat."""
_BACK = np.sin(np.radians(20.0))
"""A box shows the back of a body if its camera is farther behind the front than this sine says. At smaller angles, the back
hardly shows, and the yaw of a flat body may err by as much. With a larger sine, more bodies are tried."""
_FROM_BEHIND = 0.05
"""The most boxes that show the back of a body that was seen from its front only, as a share. A wrong box may be among many.
With a larger share, more bodies are tried."""
_NEIGHBOURS = 16
"""The number of nearest bodies among which the neighbours of a body are sought. A rack has other things above and below. A
larger number is slower."""


def hidden_flanks(edges: BoxEdges, axes: Floats) -> Floats:
    """Return how uncertain centre and half axes (N, 6, 6), m, are because the flanks of flat bodies in rows may be hidden.

    Boxes show a flat body from its front only, and a neighbour stands next to it. Then the body may go on behind its front,
    until it is as deep as it is wide, as the weak prior of bodies says. The matrix is 0 for all other bodies.

    axes: (N, 7) centre, m, half axes, m, and yaw, rad, as in `Bodies.axes`.
    """
    width_first = axes[:, 3] >= axes[:, 4]
    yaw = np.where(width_first, axes[:, 6], axes[:, 6] + np.pi / 2)
    along, across = (np.stack([np.cos(angle), np.sin(angle)], axis=1) for angle in (yaw, yaw + np.pi / 2))
    depth, width = np.sort(axes[:, 3:5], axis=1).T
    away = edges.origin[:, :2] - axes[edges.body, :2]
    off = np.einsum("bi,bi->b", away, across[edges.body])
    front = np.where(grouped(edges.body, off, len(axes)) < 0, -1.0, 1.0)  # The side of `across` that the cameras are on.
    back = -front[edges.body] * off > _BACK * np.linalg.norm(away, axis=1)
    from_behind = np.bincount(edges.body, back, len(axes)) / np.maximum(np.bincount(edges.body, minlength=len(axes)), 1)
    tried = (from_behind <= _FROM_BEHIND) & (depth < _FLAT * width) & _in_row(axes, along, width, depth)
    moved = np.column_stack([-front[:, None] * across, np.zeros(len(axes)), ~width_first, width_first, np.zeros(len(axes))])
    moved *= np.where(tried, width - depth, 0.0)[:, None]
    return np.asarray(_PROBABILITY * moved[:, :, None] * moved[:, None, :])


def _in_row(axes: Floats, along: Floats, width: Floats, depth: Floats) -> Bools:
    """Return whether another body stands next to each body (N,), to its right or to its left.

    It stands there if the gap is smaller than the depth that may be hidden. Through such a gap, no flank is seen from more
    than 45 degrees beside the front. axes: as in `hidden_flanks`. along: (N, 2) unit, along the width. width, depth: (N,)
    half axes, m.
    """
    count = min(_NEIGHBOURS + 1, len(axes))
    if count < 2:
        return np.zeros(len(axes), dtype=bool)
    one, two = np.repeat(np.arange(len(axes)), count), nearest_points(axes[:, :3], count).ravel()
    to = axes[two, :3] - axes[one, :3]
    beside = np.abs(np.einsum("bi,bi->b", to[:, :2], along[one]))
    off = np.abs(to[:, 0] * along[one, 1] - to[:, 1] * along[one, 0])
    level = np.abs(to[:, 2]) < axes[one, 5] + axes[two, 5]
    turn = np.abs(np.einsum("bi,bi->b", along[one], along[two]))
    reach = turn * width[two] + np.sqrt(np.maximum(1 - turn**2, 0.0)) * depth[two]  # Of the other body, at least.
    next_to = (one != two) & level & (off < width[one]) & (beside - width[one] - reach < 2 * (width - depth)[one])
    return np.asarray(np.bincount(one, next_to, len(axes)) > 0)
