"""Widen the covariances of objects whose boxes grow too little while the robot comes nearer.

Through a door, a robot sees a part of a thing, and the part changes as the robot drives past. So the rays cross near the
door, far in front of the thing, and this place seems sure. But the posts of a door do not hide the upper and the lower edges
of the boxes. The height of a box is inversely proportional to the distance of its thing. If the robot comes to half of the
distance and the boxes become only a little higher, the thing is farther than the place where its rays cross.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from objslam.association.observations import size_per_metre
from objslam.core.arrays import Floats, Ints
from objslam.core.camera import Camera
from objslam.core.object_map import ObjectMap
from objslam.core.statistics import grouped_median
from objslam.core.types import Association, Keyframes, Rays
from objslam.frontend.up import up_axis, up_vector
from objslam.mapping.checks.residuals import held_rays

_BIN = 0.5
"""The time (s) whose boxes count as one height, because the noise of boxes lasts. A longer time tests fewer objects."""
_FEWEST = 8
"""The fewest heights of a tested object. With a larger number, fewer objects are tested."""
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


def with_contradicting_growth(
    objects: ObjectMap,
    map_T_camera: Floats,
    keyframes: Keyframes,
    rays: Rays,
    association: Association,
    weight: Floats,
    cameras: tuple[Camera, ...],
    pixel_sigma: float,
) -> ObjectMap:
    """Return the objects, with wider covariances where the heights of boxes contradict the place. They reach to the place by
    the heights.

    For each object, places along the mean view are tried. The logarithm of height times distance is constant at the true
    place. The place with the least variance counts. If it is far behind the object and explains the heights much better, the
    square of the distance between both places is added to the variance along the view. map_T_camera: (K, 4, 4) the solved
    poses of the cameras at the keyframes. weight: (R,) the weight of each ray, 0 for a rejected one and for a box that may
    be hidden. pixel_sigma: px, the standard deviation of the edge of a box.
    """
    held = _used(objects, map_T_camera, keyframes, rays, association, weight, cameras)
    if not len(held):
        return objects
    time = np.floor(keyframes.frame_stamps[rays.keyframe[held]] / _BIN).astype(np.int64)
    pairs, at = np.unique(np.column_stack([association.object[held], time]), axis=0, return_inverse=True)
    at, owner = at.ravel(), pairs[:, 0]
    side = rays.box[held, 3] - rays.box[held, 1]
    told = np.log(size_per_metre(rays.take(held), keyframes, cameras)[:, 1])
    height, noise = (grouped_median(values, at, len(pairs)) for values in (told, np.sqrt(2.0) * pixel_sigma / side))
    origins = rays.in_map(map_T_camera)[0][held]
    origin = np.stack([grouped_median(column, at, len(pairs)) for column in origins.T], axis=1)
    changed = list(objects.objects)
    for j in np.flatnonzero(np.bincount(owner, minlength=len(objects)) >= _FEWEST).tolist():
        one, mine = changed[j], owner == j
        if one.covariance is None or one.position is None or one.status != "ok":
            continue
        way = _to_other_place(one.position, origin[mine], height[mine], float(np.median(noise[mine])))
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
