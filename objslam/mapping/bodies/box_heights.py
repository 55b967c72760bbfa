"""Widen the covariances of objects that the heights of their boxes contradict.

The height of a box is inversely proportional to the distance of its thing. So height times distance is the same for all
boxes of a thing that is seen whole. It is not the same if something without a box, such as a table, hides parts of the
thing, or if the boxes show several things. Then the centres of the boxes err, too.

Through a door, a robot sees a part of a thing, and the part changes as the robot drives past. So the rays cross near the
door, far in front of the thing, and this place seems sure. But the posts of a door do not hide the upper and the lower edges
of the boxes. If the robot comes to half of the distance and the boxes become only a little higher, the thing is farther than
the place where its rays cross.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from objslam.association.observations import MIN_DEPTH, size_per_metre
from objslam.core.arrays import Floats, Ints
from objslam.core.camera import Camera
from objslam.core.geometry import is_planar
from objslam.core.object_map import ObjectMap
from objslam.core.statistics import NORMAL_MEDIAN, grouped_median
from objslam.core.types import Association, Keyframes, Rays
from objslam.frontend.up import up_axis, up_vector
from objslam.mapping.checks.residuals import held_rays

_BIN = 0.5
"""The time (s) whose boxes count as one height, because the noise of boxes lasts. A longer time tests fewer objects."""
_FEWEST = 8
"""The fewest heights of a tested object. With a larger number, fewer objects are tested."""
_BOXES = 10
"""The fewest boxes from which the scatter of the height of an object is measured. A larger number tests fewer objects."""
_OTHERS = 5
"""The fewest objects from which the usual scatter is measured. With fewer objects, `_SCATTER` counts. With a larger
number, `_SCATTER` counts in more maps."""
_SCATTER = 0.07
"""The least usual scatter of heights, in natural logarithms, without the noise of edges. In two simulated flats, things seen
whole had up to 0.09, and wrong chairs 0.1 to 0.24. With a larger value, fewer objects become wider."""
_LEVEL = np.sin(np.radians(20.0))
"""The sine of the largest slope of a used ray. In steep views, a box shows the depth of its thing as well as its height. A
larger slope tests more objects, and takes some near things with depth for far ones."""
_FARTHER = np.concatenate([[0.0], np.geomspace(0.05, 1.5, 30)])
"""The tried distances behind an object, as multiples of its usual distance. More values are finer and slower."""
_LEAST = 0.2
"""The least distance between the two places of a contradiction, as a multiple of the usual distance. Boxes with a constant
margin (px) look as if things were up to a tenth farther. With a larger value, fewer objects become wider."""
_SIGMAS = 4.0
"""The least significance of a contradiction, in standard deviations. Of 250 right objects of simulated streets and orchards,
one had 3.7, and the others had less. With a larger number, fewer objects become wider."""
_EXPLAINED = 0.55
"""The least share of the variance of the heights that the farther place explains. If leaves or grass hide parts of a thing,
its heights scatter more than they follow: right objects had at most 0.5. With a larger share, fewer objects become wider."""


def with_box_heights(
    objects: ObjectMap,
    map_T_camera: Floats,
    keyframes: Keyframes,
    rays: Rays,
    association: Association,
    weight: Floats,
    cameras: tuple[Camera, ...],
    pixel_sigma: float,
) -> ObjectMap:
    """Return the objects, with wider covariances where the heights of boxes contradict the place.

    Only robots on a plane are judged. The views of a camera in the hand rise and sink, so boxes also show the depths of
    things. If the heights of an object scatter more than usual, its covariance is multiplied by the squared ratio (as the
    ratio of Birge 1932). If they say that the thing is farther, the covariance also reaches to the place by the heights
    (`_with_growth`). map_T_camera: (K, 4, 4) the solved poses of the cameras at the keyframes. weight: (R,) the weight of
    each ray, 0 for a rejected one and for a box that may be hidden by another box. pixel_sigma: px, the standard deviation
    of the edge of a box.
    """
    if not is_planar(keyframes.map_T_base):
        return objects
    held = _used(objects, map_T_camera, keyframes, rays, association, weight, cameras)
    size = size_per_metre(rays.take(held), keyframes, cameras)[:, 1]
    held, size = held[size > 0], size[size > 0]  # The size is NaN where the lens model has no inverse.
    if not len(held):
        return objects
    places = np.array([np.full(3, np.nan) if one.position is None else one.position for one in objects.objects])
    boxes = _Boxes(
        association.object[held],
        keyframes.frame_stamps[rays.keyframe[held]],
        rays.in_map(map_T_camera)[0][held],
        np.log(size),
        rays.box[held, 3] - rays.box[held, 1],
    )
    times = _scatter(boxes, places, pixel_sigma)
    changed = [
        one if one.covariance is None or times[j] <= 1 else replace(one, covariance=one.covariance * times[j] ** 2)
        for j, one in enumerate(objects.objects)
    ]
    return _with_growth(replace(objects, objects=tuple(changed)), boxes, pixel_sigma)


@dataclass(frozen=True)
class _Boxes:
    """B boxes of objects. owner: (B,) the object. stamps: (B,) s. origins: (B, 3) m, the places of the camera. height: (B,)
    the logarithm of the height, in m per m of distance. side: (B,) px, the height in the image."""

    owner: Ints
    stamps: Floats
    origins: Floats
    height: Floats
    side: Floats


def _scatter(boxes: _Boxes, places: Floats, pixel_sigma: float) -> Floats:
    """Return the scatter of the heights of each object (N,), as a multiple of the usual scatter. It is 1 for an object with
    few boxes. places: (N, 3) m."""
    owner, count = boxes.owner, len(places)
    size = boxes.height + np.log(np.maximum(np.linalg.norm(places[owner] - boxes.origins, axis=1), MIN_DEPTH))
    off = size - grouped_median(size, owner, count)[owner]
    # The noise of an edge, px, from the scatter of most boxes. Each of the two edges has it, hence sqrt(2).
    edge = min(float(np.median(np.abs(off) * boxes.side)) / (NORMAL_MEDIAN * np.sqrt(2)), pixel_sigma)
    number = np.bincount(owner, minlength=count)
    each = np.maximum(number, 1)
    variance = np.bincount(owner, size**2, count) / each - (np.bincount(owner, size, count) / each) ** 2
    beyond = np.sqrt(np.maximum(variance - np.bincount(owner, 2 * (edge / boxes.side) ** 2, count) / each, 0.0))
    judged = number >= _BOXES
    usual = max(float(np.median(beyond[judged])), _SCATTER) if judged.sum() >= _OTHERS else _SCATTER
    return np.where(judged, np.maximum(beyond / usual, 1.0), 1.0)


def _with_growth(objects: ObjectMap, boxes: _Boxes, pixel_sigma: float) -> ObjectMap:
    """Return the objects, with covariances that reach to the place by the heights where the place contradicts them.

    For each object, places along the mean view are tried. The logarithm of height times distance is constant at the true
    place. The place with the least variance counts. If it is far behind the object and explains the heights much better, the
    square of the distance between both places is added to the variance along the view.
    """
    time = np.floor(boxes.stamps / _BIN).astype(np.int64)
    pairs, at = np.unique(np.column_stack([boxes.owner, time]), axis=0, return_inverse=True)
    at, owner = at.ravel(), pairs[:, 0]
    columns = boxes.height, np.sqrt(2.0) * pixel_sigma / boxes.side, *boxes.origins.T
    height, noise, *origin = (grouped_median(values, at, len(pairs)) for values in columns)
    origins = np.stack(origin, axis=1)
    changed = list(objects.objects)
    for j in np.flatnonzero(np.bincount(owner, minlength=len(objects)) >= _FEWEST).tolist():
        one, mine = changed[j], owner == j
        if one.covariance is None or one.position is None or one.status != "ok":
            continue
        way = _to_other_place(one.position, origins[mine], height[mine], float(np.median(noise[mine])))
        if way is not None:
            changed[j] = replace(one, covariance=one.covariance + np.outer(way, way))
    return replace(objects, objects=tuple(changed))


def _used(
    objects: ObjectMap,
    map_T_camera: Floats,
    keyframes: Keyframes,
    rays: Rays,
    association: Association,
    weight: Floats,
    cameras: tuple[Camera, ...],
) -> Ints:
    """Return the rays (n,) of objects whose boxes show a height in a nearly level view."""
    sized = np.array([camera.sees_size for camera in cameras], dtype=bool)[keyframes.camera[rays.keyframe]]
    held = np.flatnonzero(held_rays(objects, association) & (weight > 0) & sized)
    held = held[(rays.box[held, 2:] > rays.box[held, :2]).all(axis=1)]
    slope = rays.in_map(map_T_camera)[1][held] @ up_vector(up_axis(keyframes))
    return held[np.abs(slope) <= _LEVEL]


def _to_other_place(position: Floats, origins: Floats, height: Floats, noise: float) -> Floats | None:
    """Return the way (3,), m, from an object to the place by the heights of its boxes. None if the heights agree with the
    object's place.

    position: (3,) m. origins: (n, 3) m, the places of the camera. height: (n,) the logarithms of heights, in m per m of
    distance. noise: the standard deviation of these logarithms by the noise of boxes.
    """
    to = position - origins
    distance = np.linalg.norm(to, axis=1)
    ahead = (to / distance[:, None]).sum(axis=0)
    ahead /= max(float(np.linalg.norm(ahead)), 1e-9)
    usual = float(np.median(distance))
    tried = to[None] + (usual * _FARTHER)[:, None, None] * ahead
    squares = (height + np.log(np.linalg.norm(tried, axis=2))).var(axis=1)
    best = int(squares.argmin())
    gain, left = squares[0] - squares[best], squares[best]
    if _FARTHER[best] < _LEAST or gain < _EXPLAINED * squares[0]:
        return None
    count = len(height)
    if gain * count < _SIGMAS**2 * (left * count / (count - 2) + noise**2):
        return None
    return np.asarray(_FARTHER[best] * usual * ahead)
