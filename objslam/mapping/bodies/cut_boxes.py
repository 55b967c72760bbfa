"""The bodies of boxes that the image's edge cuts off.

Such a box says less than a whole one. At a cut off edge, the body reaches at least as far as the box, and maybe farther. The
same is true of an edge that the body may touch outside the image. So both kinds of edges are only bounds. The body touches
all other edges. Detectors often end a cut off box before the image's edge. So each bound is at the edge of the box, not at
the edge of the image.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from objslam.core.arrays import Bools, Floats, Ints
from objslam.core.bodies.cut_boxes import CutBoxes
from objslam.core.camera import Camera, undistort
from objslam.core.statistics import NORMAL_MEDIAN, distinct
from objslam.core.types import Keyframes, Rays
from objslam.frontend.bearings import cut_edges
from objslam.mapping.bodies.box_views import BoxViews
from objslam.mapping.solution import Solution
from objslam.triangulation.bodies.edges import BoxEdges
from objslam.triangulation.bodies.residuals import residuals_of_shapes, touched_points
from objslam.triangulation.bodies.shared import spread_of
from objslam.triangulation.bodies.solve import Bodies

_CHI2 = 13.28
"""The largest squared deviation of a box from the predicted box of its body. It is the 99 % quantile of chi-squared with 4
degrees of freedom. A larger value accepts boxes of other things."""
_FEWEST = 2
"""The fewest edges of a used box that the body touches. The other edges are bounds: the body reaches at least to them. One
touched edge alone agrees with too many bodies. In simulated drives, boxes with one touched edge made centres a little worse.
With a larger number, fewer boxes are used."""
_WITHIN = 0.1
"""The largest distance from the cut at which the body touches an edge that counts as a bound, as a share of the box. An edge
that the body touches outside the image is always a bound. A larger share makes more edges bounds. Shares from 0 to 0.1
hardly differ in simulated drives."""


def cut_edges_of(bodies: Bodies, boxes: BoxViews, objects: Ints, solution: Solution) -> BoxEdges | None:
    """Return the edges of the cut off boxes that belong to bodies. None if there are none.

    A box belongs to a body of its label under three conditions. The box is near the predicted box of the body. The box is
    near no other body. The image has no other box that is near the body or belongs to it.

    bodies: n bodies. boxes: the whole boxes of the bodies. objects: (n,) the objects of the bodies in the association of the
    solution.
    """
    cut = solution.rays.cut
    if cut is None or not len(cut):
        return None
    cut = clipped(cut, boxes.cameras)
    keyframe = keyframe_of(cut, solution.keyframes)
    box, body = _candidates(cut, keyframe, bodies, boxes, objects, solution)
    if not len(box):
        return None
    edges = _edges(cut, keyframe, box, body, bodies, boxes)
    deviation, use = _deviations(edges, bodies)
    near = np.flatnonzero((use * deviation**2).sum(axis=1) < _CHI2)
    near = near[_single(box[near]) & _single(keyframe[box[near]] * len(objects) + body[near])]
    near = near[(~edges.bound[near]).sum(axis=1) >= _FEWEST]
    if not len(near):
        return None
    # A detector may be less exact for cut off things than for whole ones.
    noisier = max(1.0, float(np.median(np.abs(deviation[near])[use[near] > 0]) / NORMAL_MEDIAN))
    found = edges.take(near)
    return replace(found, **{name: noisier * getattr(found, name) for name in ("sigma", "shift", "size")})


def clipped(cut: CutBoxes, cameras: tuple[Camera, ...]) -> CutBoxes:
    """Return the boxes without their parts outside the image."""
    sizes = np.array([one.size for one in cameras])[cut.camera]
    return replace(cut, box=np.clip(cut.box, 0.0, np.tile(sizes - 1, 2)))


def _single(number: Ints) -> Bools:
    """Return which numbers (P,) occur once."""
    _, inverse, count = np.unique(number, return_inverse=True, return_counts=True)
    return count[inverse.ravel()] == 1


def keyframe_of(cut: CutBoxes, keyframes: Keyframes) -> Ints:
    """Return the keyframe (C,) of each box, -1 for an image that is no keyframe."""
    wide = int(max(keyframes.frame.max(), cut.frame.max())) + 1
    image, wanted = keyframes.camera * wide + keyframes.frame, cut.camera * wide + cut.frame
    order = np.argsort(image)
    at = order[np.clip(np.searchsorted(image[order], wanted), 0, len(image) - 1)]
    return np.where(image[at] == wanted, at, -1)


def _candidates(
    cut: CutBoxes, keyframe: Ints, bodies: Bodies, boxes: BoxViews, objects: Ints, solution: Solution
) -> tuple[Ints, Ints]:
    """Return pairs (P,) of boxes and bodies of one label whose directions are near. The image has no whole box of the body.

    The first array has the boxes, and the second array the bodies.
    """
    association, held = solution.association, solution.association.object >= 0
    whole = distinct(solution.rays.keyframe[held] * association.count + association.object[held])
    sees_size = np.array([c.sees_size for c in boxes.cameras])[cut.camera]
    wide = (cut.box[:, 2:] > cut.box[:, :2]).all(axis=1)
    usable = np.flatnonzero((keyframe >= 0) & sees_size & wide)
    origin, axis, angle = cones(cut.take(usable), boxes.map_T_camera[keyframe[usable]], boxes.cameras)
    none = np.zeros(0, dtype=np.int64)
    found = [(none, none)]
    for at in np.flatnonzero(bodies.shape > 0).tolist():
        mine = np.flatnonzero(cut.label[usable] == association.label[objects[at]])
        wanted = keyframe[usable[mine]] * association.count + objects[at]
        mine = mine[np.searchsorted(whole, wanted) == np.searchsorted(whole, wanted, side="right")]
        towards = bodies.axes[at, :3] - origin[mine]
        distance, reach = np.linalg.norm(towards, axis=1), np.linalg.norm(bodies.axes[at, 3:6])
        outside = np.flatnonzero(distance > reach)
        mine, towards, distance = mine[outside], towards[outside] / distance[outside, None], distance[outside]
        off = np.arccos(np.clip((towards * axis[mine]).sum(axis=1), -1.0, 1.0))
        near = mine[off < np.minimum(angle[mine] + np.arcsin(reach / distance), np.pi / 2)]
        found.append((usable[near], np.full(len(near), at)))
    box, body = (np.concatenate(part) for part in zip(*found, strict=True))
    return box, body


def cones(cut: CutBoxes, map_T_camera: Floats, cameras: tuple[Camera, ...]) -> tuple[Floats, Floats, Floats]:
    """Return origins (C, 3), m, axes (C, 3) in map and half angles (C,), rad, of cones around boxes.

    map_T_camera: (C, 4, 4) the pose of the camera for each box. A box where the lens model has no inverse gets a cone of the
    whole half space.
    """
    axis, angle = np.zeros((len(cut), 3)), np.full(len(cut), np.pi / 2)
    box = cut.box
    pixel = np.stack([(box[:, :2] + box[:, 2:]) / 2, *(box[:, [i, j]] for i in (0, 2) for j in (1, 3))], axis=1)
    for i in np.unique(cut.camera):
        mine = np.flatnonzero(cut.camera == i)
        ray, valid = undistort(cameras[i], pixel[mine].reshape(-1, 2))
        ray = ray.reshape(-1, 5, 3)
        widest = np.arccos(np.clip((ray[:, 1:] * ray[:, :1]).sum(axis=2).min(axis=1), -1.0, 1.0))
        axis[mine] = ray[:, 0]
        angle[mine] = np.where(valid.reshape(-1, 5).all(axis=1), widest, np.pi / 2)
    return map_T_camera[:, :3, 3], np.einsum("bij,bj->bi", map_T_camera[:, :3, :3], axis), angle


def _edges(cut: CutBoxes, keyframe: Ints, box: Ints, body: Ints, bodies: Bodies, boxes: BoxViews) -> BoxEdges:
    """Return the edges of pairs (P,) of boxes and bodies, with their bounds."""
    count, camera = len(box), cut.camera[box]
    unknown, none = np.full(count, np.nan), np.zeros(count)
    rays = Rays(
        keyframe=keyframe[box],
        direction=np.zeros((count, 3)),
        sigma=none,
        range=unknown,
        range_sigma=none + 1,
        range_bias=none,
        label=cut.label[box],
        score=none,
        box=cut.box[box],
        track_id=np.full(count, -1),
        label_names=(),
    )
    bound = np.zeros((count, 4), dtype=bool)
    for i in np.unique(camera):
        mine = np.flatnonzero(camera == i)
        bound[mine] = cut_edges(rays.box[mine], boxes.cameras[i], boxes.settings)
    views = replace(boxes, rays=rays, body=body, bound=bound)
    rough = views.edges()
    touched = touched_points(rough, bodies.values, bodies.shape)
    return replace(views, bound=bound | _touches_outside(views, touched)).edges(touched)


def _touches_outside(views: BoxViews, touched: Floats) -> Bools:
    """Return which edges (B, 4) a body may touch outside the image. touched: (B, 4, P, 3) m, the points that edges may
    touch."""
    pose, box, at = views.poses, views.rays.box, views.contacts(touched)
    depth = ((touched[:, :, 0] - pose[:, None, :3, 3]) * pose[:, None, :3, 2]).sum(axis=2)
    low, high = box[:, [1, 0, 1, 0]], box[:, [3, 2, 3, 2]]  # The ends of each edge.
    margin = _WITHIN * (high - low)
    before = views.bound[:, [1, 0, 1, 0]] & (at <= low + margin)
    after = views.bound[:, [3, 2, 3, 2]] & (at >= high - margin)
    return before | after | (depth <= 0)


def _deviations(edges: BoxEdges, bodies: Bodies) -> tuple[Floats, Floats]:
    """Return the differences (B, 4) between boxes and the predicted boxes of their bodies, and which differences (B, 4)
    count.

    The differences are in standard deviations of boxes and bodies together.
    """
    found = residuals_of_shapes(edges, bodies.values, bodies.shape)
    value, by, use = found.value[:, :4], found.by[:, :4], found.use[:, :4]
    own = np.einsum("bri,bij,brj->br", by, bodies.covariance[edges.body], by)
    return value / np.sqrt(own + spread_of(edges, bodies.factors, bodies.share)[:, :4] ** 2), use
