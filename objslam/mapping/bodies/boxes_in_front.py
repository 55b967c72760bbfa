"""Find edges of boxes that may belong to a thing in front, from the other boxes of the image and from the map. The body
behind may reach beyond such an edge. A box of a thing without a place in the map counts as in front, because its distance is
unknown. A box that the edge of the image cuts off also counts as in front."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from objslam.association.observations import extents
from objslam.config import Settings
from objslam.core.arrays import Bools, Floats, Ints
from objslam.core.bodies.covered_edges import covered_shares, pairs_in_images
from objslam.core.camera import Camera
from objslam.mapping.bodies.cut_boxes import clipped, keyframe_of
from objslam.mapping.solution import Solution

_FARTHER = 0.25
"""A thing still counts as in front of another if its centre is farther by at most this share of the sum of their apparent
half axes. One end of a long desk can lie behind a chair whose centre is farther than the centre of the desk. With a share of
0, such a chair was not in front from most sides. If two things only touch in the image, the edges there are bounds for both
things. Views in which the things do not touch show their ends. With a larger share, more things are in front."""
_COVERED = 0.5
"""An edge is hidden if boxes in front cover more than this share of it. In simulated drives, 0.5 finds 98 % of the edges
that are hidden by 12 px. A share of 0.1 finds the same 98 %, and 50 % more edges that are not hidden. With a larger share,
fewer edges are found."""
_ALIKE = 2.0
"""The largest difference of two edges that are the same, in standard deviations of their noise. A larger number finds more
hidden edges, and more edges that are not hidden."""
_OFF = 0.25
"""The root mean square distance between the centre of a thing and the centre of its visible part, as a share of the visible
size. This distance is half of the hidden length. The root mean square of the hidden length is half of the visible size. A
larger share makes positions less sure."""


def edges_behind_boxes(
    solution: Solution, cameras: tuple[Camera, ...], settings: Settings, map_T_camera: Floats, half: Floats, ray: Ints
) -> Bools:
    """Return which edges (B, 4) of the boxes of some rays may belong to a thing in front.

    map_T_camera: (K, 4, 4) the poses of the cameras at the keyframes. half: (N,) m, the apparent half axes of the objects,
    NaN if unknown. ray: (B,) the rays.
    """
    rays, association, estimate = solution.rays, solution.association, solution.estimate
    box, image, count = rays.box, rays.keyframe, len(rays)
    held = np.flatnonzero((association.object >= 0) & (estimate.weight > 0))
    owner = association.object[held]
    away, wide = np.full(count, np.nan), np.full(count, np.nan)
    away[held] = np.linalg.norm(estimate.positions[owner] - map_T_camera[image[held], :3, 3], axis=1)
    away, wide[held] = np.where(np.isfinite(rays.range), rays.range, away), half[owner]
    cut = rays.cut
    if cut is not None and len(cut):
        box, image = (
            np.concatenate([box, clipped(cut, cameras).box]),
            np.concatenate([image, keyframe_of(cut, solution.keyframes)]),
        )
        away, wide = (np.append(part, np.full(len(cut), np.nan)) for part in (away, wide))
    wanted = np.zeros(len(box), dtype=bool)
    wanted[ray] = True
    used = np.flatnonzero((image >= 0) & (box[:, 2:] > box[:, :2]).all(axis=1))
    size = np.sqrt(np.maximum(box[:, 2:] - box[:, :2], 0.0).prod(axis=1))
    variance = 2 * (settings.rays.pixel_sigma**2 + (settings.rays.box_sigma * size) ** 2)
    covered = np.zeros((len(box), 4))
    for pair in pairs_in_images(image[used]):
        behind, front = (used[part] for part in pair)
        margin = _FARTHER * np.nan_to_num(wide[behind] + wide[front])
        # A comparison with an unknown distance is false.
        may = wanted[behind] & ~(away[front] > away[behind] + margin)
        behind, front = behind[may], front[may]
        alike = _ALIKE * np.sqrt(variance[behind] + variance[front])
        np.add.at(covered, behind, covered_shares(box[behind], box[front], alike))
    return covered[ray] > _COVERED


def with_hidden_parts(solution: Solution, cameras: tuple[Camera, ...]) -> Solution:
    """Return the solution with wider covariances of the points whose boxes are partly hidden.

    The rays of such boxes all miss the object on the same side. So more rays do not make the object's point more exact. The
    covariances of the centres of bodies contain this error already.
    """
    estimate, association, keyframes = solution.estimate, solution.association, solution.keyframes
    if solution.hidden is None or not solution.hidden.any():
        return solution
    held = np.flatnonzero((association.object >= 0) & (estimate.weight > 0))
    owner = association.object[held]
    number = np.maximum(np.bincount(owner, minlength=association.count), 1)
    share = np.bincount(owner, solution.hidden[held], association.count) / number
    map_T_camera = estimate.map_T_base @ keyframes.base_T_camera
    size = extents(solution.rays, association, estimate.positions, map_T_camera, keyframes, cameras)
    off = _OFF * share * np.nan_to_num(np.sqrt(size.prod(axis=1)))
    covariance = estimate.covariance + off[:, None, None] ** 2 * np.eye(3)
    return replace(solution, estimate=replace(estimate, covariance=covariance))
