"""What should have been seen: which object lies in the image of which frame, and was it detected there."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from objslam.association.extent import grouped_median, grouped_quantile
from objslam.association.sightings import MIN_DEPTH, Sightings
from objslam.rays import project, undistort
from objslam.types import Bools, Camera, Floats, Ints

_CHUNK = 1 << 20  # pairs of an object and a frame at a time
_RANGES = (0.02, 0.98)  # of the distances at which a class is detected: closer or further, a miss says nothing
_CORE_SHARE = 0.8  # of the boxes of a class, those of its strongest objects, tell its distances: the weakest may be phantoms
_FACING = 0.95  # share of an object's boxes that come from its front, if it has one
_CLOSER = (0.3, 0.1)  # m, and share of the distance, by which something must be closer to hide an object
_FILLED = 0.6  # of a box, width and height, that its object surely fills


@dataclass(frozen=True)
class View:
    """The frames: stamps (F,) s; cameras, camera (F,) of each frame, map_T_camera (F, 4, 4).

    margin px, margin_share of its size: how close to the image's edge a box is still used; a negative margin: anywhere.
    """

    stamps: Floats
    cameras: tuple[Camera, ...]
    camera: Ints
    map_T_camera: Floats
    margin: float
    margin_share: float

    def __len__(self) -> int:
        return len(self.camera)

    @property
    def solid_angle(self) -> float:
        """What the cameras see, sr, on average over the frames."""
        half = np.array([[c.width / c.matrix[0, 0] / 2, c.height / c.matrix[1, 1] / 2] for c in self.cameras])
        each = 4 * np.arctan(half.prod(axis=1) / np.sqrt(1 + (half**2).sum(axis=1)))
        return float(each[self.camera].mean()) if len(self) else 1.0


@dataclass(frozen=True)
class Visits:
    """Pairs of an object and a frame where it was detected or should have been, by object and frame in increasing order.

    object, frame: (V,). detected: (V,). inside: (N,) in how many frames each object's box lies in the image, no further away
    than the furthest of its own boxes, or of its class.
    """

    object: Ints
    frame: Ints
    detected: Bools
    inside: Ints

    @property
    def count(self) -> int:
        """Number of objects, N."""
        return len(self.inside)

    @property
    def expected(self) -> Ints:
        """(N,) in how many frames each object was or should have been detected."""
        return np.bincount(self.object, minlength=self.count)

    @property
    def seen(self) -> Ints:
        """(N,) in how many it was."""
        return np.bincount(self.object[self.detected], minlength=self.count)


def visits(s: Sightings, matched: Ints, position: Floats, kind: Ints, view: View) -> Visits:
    """Where the objects at positions (N, 3) were detected or should have been.

    matched: (R,) the object of each sighting, -1 none. kind: (N,) the class of each object. An object should be detected
    where its box lies in the image, at a distance at which its class, or most often itself, is detected, from its front if
    it has one, and where no box covers it whose object is closer.
    """
    count = len(position)
    held = np.flatnonzero(matched >= 0)
    index = matched[held]
    distance = np.full(len(s), np.nan)
    distance[held] = np.linalg.norm(position[index] - s.origin[held], axis=1)
    size = s.size[held] * distance[held, None]
    extent = np.nan_to_num(np.stack([grouped_median(column, index, count) for column in size.T], axis=1))
    near, far = _usual_ranges(distance[held], index, kind)
    own = np.nan_to_num(grouped_median(distance[held], index, count))
    near, far = np.minimum(own, near[kind]), np.maximum(own, far[kind])
    reach = np.maximum(np.nan_to_num(grouped_quantile(distance[held], index, count, 1.0)), far)

    pairs = [(np.zeros(0, dtype=np.int64), np.zeros(0, dtype=np.int64), np.zeros(0), np.zeros((0, 2)))]
    for number, camera in enumerate(view.cameras):
        frames = np.flatnonzero(view.camera == number)
        step = max(1, _CHUNK // max(count, 1))
        for begin in range(0, len(frames), step):
            pairs.append(_in_image(position, extent, reach, camera, frames[begin : begin + step], view))
    obj, frame, away, pixel = (np.concatenate(column) for column in zip(*pairs, strict=True))
    inside = np.bincount(obj, minlength=count)
    usual = (away >= near[obj]) & (away <= far[obj])
    usual &= _from_the_front(s.origin[held], index, position, obj, view.map_T_camera[frame, :3, 3])
    obj, frame, away, pixel = obj[usual], frame[usual], away[usual], pixel[usual]
    clear = ~_hidden(frame, away, pixel, s, np.where(np.isfinite(s.range), s.range, distance))
    there = np.sort(index * len(view) + s.frame[held])
    key = np.sort(np.concatenate([obj[clear] * len(view) + frame[clear], there]))
    key = key[np.append(True, np.diff(key) > 0)[: len(key)]]
    at = np.minimum(np.searchsorted(there, key), max(len(there) - 1, 0))
    detected = there[at] == key if len(there) else np.zeros(len(key), dtype=bool)
    return Visits(key // len(view), key % len(view), detected, inside)


def _usual_ranges(distance: Floats, index: Ints, kind: Ints) -> tuple[Floats, Floats]:
    """Between which distances (C,) the objects of each class are detected; distance, index: (P,) of each box."""
    number = np.bincount(index, minlength=len(kind))
    order = np.lexsort((-number, kind))
    before = np.cumsum(number[order]) - number[order]
    before -= before[np.searchsorted(kind[order], kind[order])]
    core = np.zeros(len(kind), dtype=bool)
    core[order] = before <= _CORE_SHARE * np.bincount(kind, number)[kind[order]]
    told = core[index]
    classes = int(kind.max(initial=-1)) + 1
    near, far = (grouped_quantile(distance[told], kind[index[told]], classes, q) for q in _RANGES)
    return near, far


def _from_the_front(origin: Floats, index: Ints, position: Floats, obj: Ints, camera: Floats) -> Bools:
    """Whether a camera (V, 3) looks at its object (V,) from where that can be detected: a screen, say, only from one side.

    An object has a front if its boxes, seen from origins (P, 3) with the object of each (P,), come from one half of the
    directions about their mean; then misses from the other half say nothing.
    """
    count = len(position)
    front = np.stack([np.bincount(index, c, count) for c in _unit(origin - position[index]).T], axis=1)
    facing = np.einsum("pi,pi->p", _unit(origin - position[index]), front[index])
    one_sided = np.nan_to_num(grouped_quantile(facing, index, count, 1 - _FACING)) >= 0
    return ~one_sided[obj] | (np.einsum("vi,vi->v", camera - position[obj], front[obj]) >= 0)


def _unit(vectors: Floats) -> Floats:
    return np.asarray(vectors / np.maximum(np.linalg.norm(vectors, axis=1, keepdims=True), 1e-9))


def _in_image(
    position: Floats, extent: Floats, reach: Floats, camera: Camera, frames: Ints, view: View
) -> tuple[Ints, Ints, Floats, Floats]:
    """Object, frame, distance (V,) and pixel (V, 2) where the boxes of the objects lie in the image, within reach (N,) m."""
    poses = view.map_T_camera[frames]
    centre = poses[:, :3, 3].mean(axis=0)
    point, origin, ahead = position - centre, poses[:, :3, 3] - centre, poses[:, :3, 2]
    distance2 = (origin**2).sum(axis=1)[:, None] + (point**2).sum(axis=1) - 2 * origin @ point.T
    depth = ahead @ point.T - (ahead * origin).sum(axis=1)[:, None]
    cos = np.cos(_widest(camera))
    bound = np.maximum(distance2, 0.0) * cos**2
    in_cone = (depth > MIN_DEPTH) & (depth * depth >= bound) if cos > 0 else depth > MIN_DEPTH
    f, n = np.nonzero(in_cone & (distance2 <= (reach + 1e-6) ** 2))
    local = np.einsum("vji,vj->vi", poses[f, :3, :3], position[n] - poses[f, :3, 3])
    pixel = project(camera, local)
    half = np.zeros((len(n), 2))
    if view.margin >= 0:
        box = extent[n] * np.diag(camera.matrix)[:2] / local[:, 2:]
        half = box / 2 + np.maximum(view.margin, view.margin_share * box)
    inside = ((pixel - half >= 0) & (pixel + half <= [camera.width - 1, camera.height - 1])).all(axis=1)
    return n[inside], frames[f[inside]], np.linalg.norm(local[inside], axis=1), pixel[inside]


def _hidden(frame: Ints, distance: Floats, pixel: Floats, s: Sightings, reach: Floats) -> Bools:
    """Whether a box whose object is closer lies over the pixel: (V,); reach: (R,) m how far each box's object is, or NaN."""
    hidden = np.zeros(len(frame), dtype=bool)
    useful = np.flatnonzero(np.isfinite(reach))
    frames = np.arange(int(max(frame.max(initial=0), s.frame.max(initial=0))) + 2)
    start = np.searchsorted(s.frame[useful], frames)
    begin, end = start[frame], start[frame + 1]
    middle, half = (s.box[:, :2] + s.box[:, 2:]) / 2, _FILLED * (s.box[:, 2:] - s.box[:, :2]) / 2
    front = distance - np.maximum(_CLOSER[0], _CLOSER[1] * distance)
    for k in range(int((end - begin).max(initial=0))):  # the k-th box of each frame: as many turns as a frame has boxes
        rows = np.flatnonzero(begin + k < end)
        box = useful[begin[rows] + k]
        closer = reach[box] < front[rows]
        rows, box = rows[closer], box[closer]
        hidden[rows] |= (np.abs(pixel[rows] - middle[box]) <= half[box]).all(axis=1)
    return hidden


def _widest(camera: Camera) -> float:
    """The angle (rad) off the optical axis of the furthest point of the image's edge.

    Beyond it a distortion model may fold back into the image what is out of sight.
    """
    u, v = np.linspace(0.0, camera.width - 1, 33), np.linspace(0.0, camera.height - 1, 33)
    sides = [np.column_stack([u, np.full_like(u, at)]) for at in (0.0, camera.height - 1)]
    sides += [np.column_stack([np.full_like(v, at), v]) for at in (0.0, camera.width - 1)]
    directions, valid = undistort(camera, np.concatenate(sides))
    return float(np.arccos(np.clip(directions[valid, 2], -1.0, 1.0)).max()) if valid.any() else np.pi / 2
