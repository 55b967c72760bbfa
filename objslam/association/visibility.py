"""Which objects should have been seen in which frames, and whether they were."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from objslam.association.observations import MIN_DEPTH, Observations
from objslam.core.arrays import Bools, Floats, Ints
from objslam.core.camera import Camera, depths, in_view
from objslam.core.statistics import grouped_median, grouped_quantile, grouped_quantiles

_PAIRS_AT_ONCE = 1 << 20  # The pairs of an object and a frame looked at together; larger needs more memory.
_USUAL_DISTANCES = (0.02, 0.98)  # The quantiles of the distances at which a class is detected; outside a miss says nothing.
_CORE_SHARE = (
    0.8  # The share of a class's boxes, from its strongest objects, that tells its distances: others may be phantoms.
)
_FRONT_SHARE = 0.95  # The least share of an object's boxes from one half of the directions for it to have a front.
_CLOSER = (0.3, 0.1)  # The metres, and the share of the distance, by which something must be closer to hide an object.
_FILLED = 0.6  # The share of a box's width and height that its object surely fills; larger hides more.


@dataclass(frozen=True)
class CameraFrames:
    """The frames that were looked at: stamps (F,) s, cameras, camera (F,) of each frame, map_T_camera (F, 4, 4).

    margin (px), margin_share (of its size): how close to the image's edge a box is still used; a negative margin: anywhere.
    """

    stamps: Floats
    cameras: tuple[Camera, ...]
    camera: Ints
    map_T_camera: Floats
    margin: float
    margin_share: float

    def __len__(self) -> int:
        return len(self.camera)

    @cached_property
    def solid_angle(self) -> float:
        """sr, what a frame sees on average."""
        each = np.array([camera.solid_angle for camera in self.cameras])
        return float(each[self.camera].mean()) if len(self) else 1.0


@dataclass(frozen=True)
class DetectionHistory:
    """The V pairs of an object and a frame where it was or should have been detected, by object, then frame.

    object, frame: (V,). detected: (V,). inside: (N,) frames in which each object's box lies in the image, no further away
    than the furthest box of the object or of its class.
    """

    object: Ints
    frame: Ints
    detected: Bools
    inside: Ints

    @cached_property
    def expected(self) -> Ints:
        """(N,) frames in which each object was or should have been detected."""
        return np.bincount(self.object, minlength=len(self.inside))

    @cached_property
    def seen(self) -> Ints:
        """(N,) frames in which each object was detected."""
        return np.bincount(self.object[self.detected], minlength=len(self.inside))


def detection_history(
    obs: Observations, matched: Ints, position: Floats, label: Ints, view: CameraFrames
) -> DetectionHistory:
    """Where the objects were or should have been detected.

    An object should be detected where its box lies in the image, at a usual distance of its class or of itself, from its
    front if it has one, and where no box of something closer covers it.

    Args:
        matched: (R,) the object of each observation, -1 none.
        position: (N, 3) m, and label: (N,), of the objects.
    """
    count = len(position)
    held = np.flatnonzero(matched >= 0)
    index = matched[held]
    distance, total = np.full(len(obs.frame), np.nan), len(view.camera)
    distance[held] = np.linalg.norm(position[index] - obs.origin[held], axis=1)
    size = obs.size[held] * distance[held, None]
    extent = np.nan_to_num(grouped_median(size, index, count))
    near, far = _usual_ranges(distance[held], index, label)
    own, furthest = (np.nan_to_num(quantile) for quantile in grouped_quantiles(distance[held], index, count, (0.5, 1.0)))
    near, far = np.minimum(own, near[label]), np.maximum(own, far[label])
    reach = np.maximum(furthest, far)

    pairs = [(np.zeros(0, dtype=np.int64), np.zeros(0, dtype=np.int64), np.zeros(0), np.zeros((0, 2)))]
    for number, camera in enumerate(view.cameras):
        frames = np.flatnonzero(view.camera == number)
        step = max(1, _PAIRS_AT_ONCE // max(count, 1))
        for begin in range(0, len(frames), step):
            pairs.append(_in_image(position, extent, reach, camera, frames[begin : begin + step], view))
    obj, frame, away, pixel = (np.concatenate(column) for column in zip(*pairs, strict=True))
    inside = np.bincount(obj, minlength=count)
    usual = (away >= near[obj]) & (away <= far[obj])
    usual &= _from_the_front(obs.origin[held], index, position, obj, view.map_T_camera[frame, :3, 3])
    obj, frame, away, pixel = obj[usual], frame[usual], away[usual], pixel[usual]
    clear = ~_hidden(frame, away, pixel, obs, np.where(np.isfinite(obs.range), obs.range, distance))
    there = np.sort(index * total + obs.frame[held])
    key = np.sort(np.concatenate([obj[clear] * total + frame[clear], there]))
    key = key[np.append(True, np.diff(key) > 0)[: len(key)]]
    at = np.minimum(np.searchsorted(there, key), max(len(there) - 1, 0))
    detected = there[at] == key if len(there) else np.zeros(len(key), dtype=bool)
    return DetectionHistory(key // total, key % total, detected, inside)


def _usual_ranges(distance: Floats, index: Ints, label: Ints) -> tuple[Floats, Floats]:
    """The least and the greatest usual distance (C,) of each class; distance, index: (P,) m and object of each box."""
    number = np.bincount(index, minlength=len(label))
    order = np.lexsort((-number, label))
    before = np.cumsum(number[order]) - number[order]
    before -= before[np.searchsorted(label[order], label[order])]
    core = np.zeros(len(label), dtype=bool)
    core[order] = before <= _CORE_SHARE * np.bincount(label, number)[label[order]]
    told = core[index]
    classes = int(label.max(initial=-1)) + 1
    near, far = grouped_quantiles(distance[told], label[index[told]], classes, _USUAL_DISTANCES)
    return near, far


def _from_the_front(origin: Floats, index: Ints, position: Floats, obj: Ints, camera: Floats) -> Bools:
    """Whether a camera at (V, 3) sees the front of its object (V,): a screen, for example, is only detected from one side.

    An object has a front if nearly all its boxes were seen from one half of the directions. Then misses from the other half
    say nothing. origin, index: (P, 3) m and (P,), where from and of what each box was seen.
    """
    count = len(position)
    front = np.stack([np.bincount(index, c, count) for c in _unit(origin - position[index]).T], axis=1)
    facing = np.einsum("pi,pi->p", _unit(origin - position[index]), front[index])
    one_sided = np.nan_to_num(grouped_quantile(facing, index, count, 1 - _FRONT_SHARE)) >= 0
    return ~one_sided[obj] | (np.einsum("vi,vi->v", camera - position[obj], front[obj]) >= 0)


def _unit(vectors: Floats) -> Floats:
    return np.asarray(vectors / np.maximum(np.linalg.norm(vectors, axis=1, keepdims=True), 1e-9))


def _in_image(
    position: Floats, extent: Floats, reach: Floats, camera: Camera, frames: Ints, view: CameraFrames
) -> tuple[Ints, Ints, Floats, Floats]:
    """Object, frame, distance (V,) and pixel (V, 2) where the boxes of the objects lie in the image, within reach (N,) m."""
    poses = view.map_T_camera[frames]
    centre = poses[:, :3, 3].mean(axis=0)
    point, origin, ahead = position - centre, poses[:, :3, 3] - centre, poses[:, :3, 2]
    distance2 = (origin**2).sum(axis=1)[:, None] + (point**2).sum(axis=1) - 2 * origin @ point.T
    depth = ahead @ point.T - (ahead * origin).sum(axis=1)[:, None]
    bound = (
        np.maximum(distance2, 0.0) * np.cos(camera.view_angle) ** 2
    )  # most objects are beyond it: they need not be projected
    in_cone = (depth > 0) & (depth * depth >= bound) & (distance2 > MIN_DEPTH**2)
    f, n = np.nonzero(in_cone & (distance2 <= (reach + 1e-6) ** 2))
    local = np.einsum("vji,vj->vi", poses[f, :3, :3], position[n] - poses[f, :3, 3])
    half = np.zeros((len(n), 2))
    if view.margin >= 0:
        box = extent[n] * np.diag(camera.matrix)[:2] / depths(camera, local)[:, None]
        half = box / 2 + np.maximum(view.margin, view.margin_share * box)
    inside, pixel = in_view(camera, local, half, camera.size - 1 - half)
    return n[inside], frames[f[inside]], np.linalg.norm(local[inside], axis=1), pixel


def _hidden(frame: Ints, distance: Floats, pixel: Floats, obs: Observations, reach: Floats) -> Bools:
    """Whether a box of something closer covers the pixel (V,); reach: (R,) m, the distance of each box's object, or NaN."""
    hidden = np.zeros(len(frame), dtype=bool)
    useful = np.flatnonzero(np.isfinite(reach))
    frames = np.arange(int(max(frame.max(initial=0), obs.frame.max(initial=0))) + 2)
    start = np.searchsorted(obs.frame[useful], frames)
    begin, end = start[frame], start[frame + 1]
    middle, half = (obs.box[:, :2] + obs.box[:, 2:]) / 2, _FILLED * (obs.box[:, 2:] - obs.box[:, :2]) / 2
    front = distance - np.maximum(_CLOSER[0], _CLOSER[1] * distance)
    number = end - begin
    most = np.argsort(-number, kind="stable")
    fewer = -number[most]
    for k in range(int(number.max(initial=0))):  # the k-th box of every frame at once
        rows = most[: np.searchsorted(fewer, -k)]  # of the frames that have a k-th box
        box = useful[begin[rows] + k]
        closer = reach[box] < front[rows]
        rows, box = rows[closer], box[closer]
        hidden[rows] |= (np.abs(pixel[rows] - middle[box]) <= half[box]).all(axis=1)
    return hidden
