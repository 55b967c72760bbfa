"""Simulate the views of the cameras, and the boxes of their detector."""

from dataclasses import dataclass, fields, replace
from typing import Self

import numpy as np

from objslam.core.appearance.features import unit_vectors
from objslam.core.arrays import Bools, Floats, Ints
from objslam.core.camera import Camera, depths, in_view, undistort
from objslam.core.geometry import inverse
from objslam.core.types import Detections
from objslam.frontend.surface_ranges import half_widths, to_centres
from objslam.simulation.settings import AppearanceNoise, DriveSettings

FALSE_SIZES = (20.0, 120.0)  # The least and the largest side length of a false box, px.
_MOST_NOISE = 20.0  # The largest noise of an appearance vector that is tried, as a multiple of the vector's length.
_HALVINGS = 30  # How often the search for the noise halves its range. With a larger number, the noise is more exact.
TRACK_PATIENCE = 1.0  # The time without a box after which a tracker loses an object, s.


@dataclass(frozen=True)
class Views:
    """The M views of objects in all images of a camera, without errors. A view is one object in one image.

    frame: (M,) the index of the image. object: (M,) the index of the object. centre, size: (M, 2) centre and size of the
    box, px. depth: (M,) z of the object's centre, m.
    """

    frame: Ints
    object: Ints
    centre: Floats
    size: Floats
    depth: Floats


@dataclass(frozen=True)
class Boxes:
    """M boxes of one camera in any order.

    frame: (M,) the index of the image. object: (M,) the id of the object in each box, -1 for a false box. label: (M,) index
    into the classes. box: (M, 4) x1, y1, x2, y2, px. score: (M,). depth: (M,) z, m, NaN without a depth.
    """

    frame: Ints
    object: Ints
    label: Ints
    box: Floats
    score: Floats
    depth: Floats

    @classmethod
    def join(cls, *parts: Self) -> Self:
        """Concatenate several sets of boxes."""
        return cls(*(np.concatenate([getattr(part, f.name) for part in parts]) for f in fields(cls)))

    def take(self, boxes: Bools | Ints) -> Self:
        """Select boxes by a mask (M,) or by indices."""
        return type(self)(*(getattr(self, f.name)[boxes] for f in fields(self)))


def views(settings: DriveSettings, camera: Camera, map_T_camera: Floats, points: Floats, extents: Floats) -> Views:
    """Return the views of the objects that a camera sees at each of its poses map_T_camera (F, 4, 4).

    points: the centres of the objects in map, m. Their shape is (N, 3), or (F, N, 3) for moving objects. extents: (N, 2) the
    width and height of the objects, m.
    """
    camera_T_map = inverse(map_T_camera)
    local = points @ np.swapaxes(camera_T_map[:, :3, :3], 1, 2) + camera_T_map[:, None, :3, 3]  # (F, N, 3)
    distance = np.linalg.norm(local, axis=-1)
    near = (distance <= settings.max_range) & (local[..., 2] > distance * np.cos(camera.view_angle))
    frame, index = np.nonzero(near)
    local = local[frame, index]
    size = extents[index] * np.diag(camera.matrix)[:2] / depths(camera, local)[:, None]
    reach = _reach(settings, size)
    seen, centre = in_view(camera, local, reach, camera.size - 1 - reach)
    return Views(frame[seen], index[seen], centre, size[seen], local[seen, 2])


def _reach(settings: DriveSettings, size: Floats) -> Floats:
    """Return the least distance (M, 2), px, of a visible box centre from the image's edges. size: (M, 2) box sizes, px."""
    return np.zeros_like(size) if settings.cut_off else size / 2


def detect(
    settings: DriveSettings, camera: Camera, seen: Views, label: Ints, seed: np.random.SeedSequence, first_id: int = 0
) -> Boxes:
    """Return the boxes of visible objects. The boxes have noise, and some objects are missed. label: (N,) the label of each
    object, as an index into the classes. first_id: the id of object 0."""
    noise, miss, score, depth = (np.random.default_rng(s) for s in seed.spawn(4))
    count = len(seen.frame)
    centre = seen.centre + settings.pixel_sigma * noise.standard_normal((count, 2))
    box = np.column_stack([centre - seen.size / 2, centre + seen.size / 2])
    if settings.cut_off:
        box = np.clip(box, 0.0, np.tile(camera.size - 1, 2))
    scores, z = score.uniform(0.5, 1.0, count), _depths(settings, _of_surfaces(settings, camera, seen), depth)
    boxes = Boxes(seen.frame, seen.object + first_id, label[seen.object], box, scores, z)
    reach = _reach(settings, seen.size)
    inside = np.asarray(((centre - reach >= 0) & (centre + reach <= camera.size - 1)).all(axis=1))
    return boxes.take(inside & (miss.random(count) >= settings.missed))


def imagine(settings: DriveSettings, camera: Camera, classes: int, seed: np.random.SeedSequence) -> Boxes:
    """Draw random false boxes. In each image, each class gets a false box with the probability `settings.false`."""
    rng, depth = (np.random.default_rng(s) for s in seed.spawn(2))
    frame, label = np.nonzero(rng.random((settings.frames, classes)) < settings.false)
    count = len(frame)
    size = rng.uniform(*FALSE_SIZES, (count, 2))
    corner = rng.random((count, 2)) * (camera.size - 1 - size)
    box, scores = np.column_stack([corner, corner + size]), rng.uniform(0.3, 0.8, count)
    z = _depths(settings, depth.uniform(0.3, settings.max_range, count), depth)
    return Boxes(frame, np.full(count, -1), label, box, scores, z)


def _of_surfaces(settings: DriveSettings, camera: Camera, seen: Views) -> Floats:
    """Return the depth (M,) z, m, of the visible surface of the object in each view. A camera measures this depth."""
    direction, _ = undistort(camera, seen.centre)
    box = np.concatenate([seen.centre - seen.size / 2, seen.centre + seen.size / 2], axis=1)
    share = 0.0 if settings.depth is None else settings.depth.surface
    half = half_widths(box, direction, [camera], np.zeros(len(box), dtype=np.int64))
    return np.asarray(seen.depth / to_centres(half, share))


def _depths(settings: DriveSettings, true: Floats, rng: np.random.Generator) -> Floats:
    noise, count = settings.depth, len(true)
    if noise is None:
        return np.full(count, np.nan)
    depth = true + np.hypot(noise.sigma, noise.sigma_per_m * true) * rng.standard_normal(count)
    depth = np.where(rng.random(count) < noise.wrong, rng.uniform(0.3, settings.max_range, count), depth)
    return np.where(rng.random(count) < noise.missing, np.nan, depth)


def order_of(boxes: Boxes) -> Ints:
    """Return the order (M,) of boxes in detections: by frame, and in a frame the box with the highest score first."""
    return np.lexsort((-boxes.score, boxes.frame))


def detections(settings: DriveSettings, boxes: Boxes, frame_stamps: Floats, classes: tuple[str, ...]) -> Detections:
    """Return the boxes as detections, sorted by frame, and within a frame by score with the highest score first.
    frame_stamps: (F,) the stamps of the images, s. classes: the class names."""
    order = order_of(boxes)
    b, tracks = boxes.take(order), _tracks(settings, boxes)[order]
    return Detections(frame_stamps, b.frame, b.box, b.label, b.score, b.depth, tracks, classes)


def with_features(cameras: list[Detections], objects: list[Ints], noise: AppearanceNoise, seed: int) -> list[Detections]:
    """Return the detections of all cameras with appearance vectors. objects: for each camera, the ids (M,) of the objects in
    its boxes, -1 for a false box. Each false box gets the vector of an object of its own."""
    rng = np.random.default_rng(seed)
    label, whose = np.concatenate([one.label for one in cameras]), np.concatenate(objects)
    whose = np.where(whose < 0, whose.max(initial=-1) + 1 + np.arange(len(whose)), whose)
    _, first, whose = np.unique(whose, return_index=True, return_inverse=True)
    kind = label[first]  # The label of each object.
    of_label, own = (
        unit_vectors(rng.normal(size=(count, noise.numbers)))[0].astype(np.float64)
        for count in (int(label.max(initial=-1)) + 1, len(first))
    )
    prototype = np.sqrt(noise.common) * of_label[kind] + np.sqrt(1 - noise.common) * own
    error = rng.normal(size=(len(whose), noise.numbers)) / np.sqrt(noise.numbers)
    standing = np.bincount(whose) > 1
    features, _ = unit_vectors(prototype[whose] + _scale(prototype, kind, standing, whose, error, noise.confusion) * error)
    ends = np.cumsum([len(one) for one in cameras])[:-1]
    return [replace(one, features=part) for one, part in zip(cameras, np.split(features, ends), strict=True)]


def _scale(prototype: Floats, kind: Ints, standing: Bools, whose: Ints, error: Floats, confusion: float) -> float:
    """Return the factor of the errors (M, D) at which a share `confusion` of the boxes looks like a wrong object.

    The vector of such a box is nearer to the vector of another object with the same label. prototype: (N, D) the vectors of
    the objects. kind: (N,) the labels of the objects. standing: (N,) whether an object has more than one box. whose: (M,)
    the object of each box.
    """
    low, high = 0.0, _MOST_NOISE
    for _ in range(_HALVINGS):
        middle, wrong = (low + high) / 2, list[Bools]()
        for label in np.unique(kind):
            rivals = np.flatnonzero((kind == label) & standing)
            mine = np.flatnonzero((kind[whose] == label) & standing[whose])
            if len(rivals) > 1:
                near = (prototype[whose[mine]] + middle * error[mine]) @ prototype[rivals].T
                wrong.append(rivals[near.argmax(axis=1)] != whose[mine])
        if not wrong:
            return 1.0
        low, high = (low, middle) if np.concatenate(wrong).mean() > confusion else (middle, high)
    return low


def _tracks(settings: DriveSettings, boxes: Boxes) -> Ints:
    if settings.tracks == "none":
        return np.full(len(boxes.frame), -1)
    if settings.tracks == "perfect":
        return boxes.object
    order = np.lexsort((boxes.frame, boxes.object))
    patience = TRACK_PATIENCE * settings.frame_rate
    starts = (np.diff(boxes.object[order], prepend=-1) != 0) | (np.diff(boxes.frame[order], prepend=0) > patience)
    tracks = np.empty(len(order), dtype=np.int64)
    tracks[order] = np.cumsum(starts)
    return np.where(boxes.object < 0, -1, tracks)
