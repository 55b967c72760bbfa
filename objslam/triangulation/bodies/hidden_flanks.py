"""Find things in a row whose flanks may be hidden by their neighbours, or by something between them.

The camera passes a row of things, such as pallets on a rack, and sees their fronts at many angles. If the neighbours or the
uprights of the rack hide the flanks at all angles, the boxes go around the fronts only. The body of such boxes is as flat as
the body of a door. Nothing else tells such a thing from a door.
"""

from __future__ import annotations

import numpy as np

from objslam.core.arrays import Bools, Floats
from objslam.core.geometry import nearest_points
from objslam.triangulation.bodies.edges import BoxEdges
from objslam.triangulation.bodies.fit import grouped

_PROBABILITY = 0.5
"""The probability that a flat body in a row has hidden flanks. It is 1/2, because boxes say nothing about hidden flanks. A
larger probability makes the centres of flat things in rows less sure."""
_FLAT = 0.5
"""The ratio of depth to width below which a body is flat. In simulations, bodies of fronts had ratios up to 0.45, and things
that showed their flanks seldom had less than 0.6. With a larger ratio, more bodies are flat."""
_BACK = np.sin(np.radians(20.0))
"""The sine of the least angle behind the plane of a body at which a camera sees the back of the body. At smaller angles, the
back hardly shows, and the yaw of a flat body may err by as much. With a larger sine, more bodies count as seen from the
front only."""
_FROM_BEHIND = 0.05
"""The largest share of boxes that may show the back of a body that counts as seen from the front only. Some boxes may be
wrong. With a larger share, more bodies count as seen from the front only."""
_NEIGHBOURS = 16
"""The number of nearest bodies among which the neighbours of a body are sought. It is more than two, because a rack has
other things above and below. A larger number is slower."""


def hidden_flanks(edges: BoxEdges, axes: Floats) -> Floats:
    """Return the uncertainty (N, 6, 6), m^2, of centres and half axes because flanks of flat bodies in rows may be hidden.

    If boxes show a flat body from its front only, and a neighbour stands next to it, the body may go on behind its front. It
    may be as deep as it is wide, as the weak prior of bodies says. The matrix is 0 for all other bodies.

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
    """Return a mask (N,) of the bodies that have another body next to them, to the right or to the left.

    A body stands next to another one if the gap is smaller than the depth that may be hidden. Through such a gap, no camera
    sees a flank from more than 45 degrees beside the front. axes: as in `hidden_flanks`. along: (N, 2) unit, along the
    width. width, depth: (N,) half axes, m.
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
