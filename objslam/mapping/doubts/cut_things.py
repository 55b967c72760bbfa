"""Things that the map lacks because the edge of the image cuts off all their boxes. Such boxes give no rays."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from objslam.core.arrays import Bools, Floats, Ints
from objslam.core.bodies.cut_boxes import CutBoxes
from objslam.core.camera import in_view
from objslam.core.geometry import inverse
from objslam.core.result import Doubt, RunResult
from objslam.core.types import Keyframes
from objslam.mapping.bodies.cut_boxes import clipped, cones, keyframe_of
from objslam.mapping.doubts.evidence import all_frames

_FEWEST = 5
"""The fewest frames that show a thing. A cut off box has a wide cone, and few cones meet anywhere. A larger number names
fewer things."""
_SEEN = 0.5
"""The least share of the frames with a thing in view that have a box of the thing. With fewer boxes, the thing is not named.
A frame has the thing in view if the image contains its place, at a distance that the frames with a box also have. A thing at
rest is in most such images. The cones of a thing that moves meet anywhere. A larger share names fewer things."""
_PAIRS = 1000
"""The number of pairs of boxes whose crossings are tried as the place of a thing. More pairs give a better place."""
_PARALLAX = np.sin(np.radians(5.0)) ** 2
"""The least squared sine of the angle between two axes that are crossed. Axes of cut off boxes point beside their thing, so
narrower crossings give no distance. With a larger value, fewer places are tried."""
_NEAR, _FAR = 0.2, 3.0
"""The limits on the distance of a tried place from a camera. The first is the least distance, m. The second gives the
greatest distance, as a multiple of the greatest distance at which an object was seen. Larger values suit larger places."""
_MOST = 5
"""The most things of one label. Nobody reads a list of more."""
_SAMPLE = 2000
"""The most boxes of a label that are looked at, evenly over the log. More boxes take longer."""


@dataclass(frozen=True)
class CutThing:
    """A thing whose boxes are all cut off.

    label: index into the label names of the rays. position: (3,) m, about where the axes of its boxes meet best. boxes: the
    number of its boxes. frames: the number of frames with a box of it. expected: the number of frames that have its place in
    the image, at the distances at which its boxes are.
    """

    label: int
    position: Floats
    boxes: int
    frames: int
    expected: int

    def place(self) -> str:
        """Return the place of the thing in words."""
        x, y, z = self.position
        return f"({x:.1f}, {y:.1f}, {z:.1f})"


@dataclass(frozen=True)
class _Cones:
    """Cones around boxes: origins (C, 3), m, unit axes (C, 3), half angles (C,), rad, and their frames (C,)."""

    origin: Floats
    axis: Floats
    angle: Floats
    frame: Ints

    def take(self, index: Ints | Bools) -> _Cones:
        """Return some of the cones."""
        return _Cones(self.origin[index], self.axis[index], self.angle[index], self.frame[index])

    def off(self, points: Floats) -> tuple[Floats, Floats]:
        """Return the angles (P, C), rad, of points (P, 3) off the axes, and their distances (P, C), m."""
        towards = points[:, None] - self.origin
        distance = np.linalg.norm(towards, axis=2)
        cosine = (towards * self.axis).sum(axis=2) / np.maximum(distance, 1e-9)
        return np.arccos(np.clip(cosine, -1.0, 1.0)), distance


def cut_things(result: RunResult) -> list[CutThing]:
    """Return the things that have only cut off boxes in a result. The one with the most boxes comes first.

    A cut off box belongs to an object if the object, with its size and 3 sigma, reaches into the cone around the box. The
    other boxes of a label show a thing where their cones meet, if most frames with this place in the image show it.
    """
    cut = result.rays.cut
    if cut is None or not len(cut):
        return []
    frames, _ = all_frames(result)
    found: list[CutThing] = []
    for label in np.unique(cut.label).tolist():
        mine = np.flatnonzero(cut.label == label)
        mine = mine[np.linspace(0, len(mine) - 1, min(_SAMPLE, len(mine))).astype(np.int64)]
        around = _cones_of(cut.take(mine), frames, result)
        left = around.take(~_explained(around, result, result.rays.label_names[label]))
        found += _of_label(left, label, frames, result)
    return sorted(found, key=lambda thing: -thing.boxes)


def in_doubts(things: list[CutThing], result: RunResult) -> list[Doubt]:
    """Return the things as doubts in words."""
    return [_doubt(thing, result) for thing in things]


def in_assessment(things: list[CutThing], result: RunResult) -> list[str]:
    """Return the sentences about the things for the assessment."""
    names = [f"{result.rays.label_names[thing.label]!r} near {thing.place()}" for thing in things]
    if not names:
        return []
    more = "" if len(names) == 1 else f" and {len(names) - 1} more"
    return [f"The image's edge cuts off all boxes of a thing that the map lacks: {names[0]}{more} (`objslam explain`)."]


def _doubt(thing: CutThing, result: RunResult) -> Doubt:
    name = result.rays.label_names[thing.label]
    return Doubt(
        "boxes",
        "cut off",
        name,
        f"The image's edge cuts off {thing.boxes} {name} boxes, roughly near {thing.place()}, where the map has no {name}: "
        "no box of this thing is whole, so no ray shows it (rays.border, rays.border_share). Drive past it farther away, so "
        "that the image shows it whole.",
        (),
        thing.position,
        np.zeros(0, dtype=np.int64),
        {"boxes_cut_off": thing.boxes, "frames": thing.frames, "frames_expected": thing.expected},
    )


def _cones_of(cut: CutBoxes, frames: Keyframes, result: RunResult) -> _Cones:
    """Return the cones of the boxes whose frame is known."""
    frame = keyframe_of(cut, frames)
    known = np.flatnonzero((frame >= 0) & (cut.box[:, 2:] > cut.box[:, :2]).all(axis=1))
    inside = clipped(cut.take(known), result.cameras)
    return _Cones(*cones(inside, frames.map_T_camera[frame[known]], result.cameras), frame[known])


def _explained(around: _Cones, result: RunResult, name: str) -> Bools:
    """Return which cones (C,) an object of a label reaches into. An unresolved object counts at the guess of its place."""
    known = np.zeros(len(around.frame), dtype=bool)
    for o in result.map:
        if (o.label == name or name in (o.labels or ())) and np.isfinite(o.position).all():
            size = float(np.linalg.norm(o.body.size if o.body is not None else (o.extent or (0.0,)))) / 2
            (off,), (distance,) = around.off(o.position[None])
            reach = np.arcsin(np.clip((size + 3 * (o.sigma or 0.0)) / np.maximum(distance, 1e-9), 0.0, 1.0))
            known |= off <= around.angle + reach
    return known


def _of_label(left: _Cones, label: int, frames: Keyframes, result: RunResult) -> Iterator[CutThing]:
    """Yield the things where cones of one label meet."""
    rng = np.random.default_rng(len(left.frame))
    for _ in range(_MOST):
        if len(np.unique(left.frame)) < _FEWEST:
            return
        places = _crossings(left, _reach(result), rng)
        if not len(places):
            return
        off, distance = left.off(places)
        inside = off < left.angle
        best = int(np.where(inside, 1 - (off / left.angle) ** 2, 0.0).sum(axis=1).argmax())
        mine, place = inside[best], places[best]
        shown, away = np.unique(left.frame[mine]), distance[best, mine]
        left = left.take(~mine)
        if len(shown) < _FEWEST:
            return
        expected = np.union1d(_frames_with(place, float(away.min()), float(away.max()), frames, result), shown)
        if len(shown) >= _SEEN * len(expected):
            yield CutThing(label, place, int(mine.sum()), len(shown), len(expected))


def _reach(result: RunResult) -> float:
    """Return the greatest distance of a place from the cameras, m."""
    held = result.association.object >= 0
    if not held.any():
        return np.inf
    positions = np.array([o.position for o in result.map])[result.association.object[held]]
    away = np.linalg.norm(positions - result.origins[held], axis=1)
    return _FAR * float(np.nanmax(away)) if np.isfinite(away).any() else np.inf


def _crossings(around: _Cones, reach: float, rng: np.random.Generator) -> Floats:
    """Return places (P, 3) where axes of cones cross ahead of both cameras."""
    i, j = rng.integers(len(around.frame), size=(2, _PAIRS))
    between, a, b = around.origin[j] - around.origin[i], around.axis[i], around.axis[j]
    cosine = (a * b).sum(axis=1)
    sine2 = np.maximum(1 - cosine**2, 1e-12)
    along_a, along_b = (between * a).sum(axis=1), (between * b).sum(axis=1)
    one, two = (along_a - cosine * along_b) / sine2, (cosine * along_a - along_b) / sine2
    middle: Floats = (around.origin[i] + one[:, None] * a + around.origin[j] + two[:, None] * b) / 2
    ahead = (np.minimum(one, two) > _NEAR) & (np.maximum(one, two) < reach)
    return middle[ahead & (sine2 > _PARALLAX)]


def _frames_with(place: Floats, near: float, far: float, frames: Keyframes, result: RunResult) -> Ints:
    """Return the frames with a place (3,) in the image, at a distance between near and far, m."""
    poses, found = frames.map_T_camera, []
    distance = np.linalg.norm(poses[:, :3, 3] - place, axis=1)
    for number, camera in enumerate(result.cameras):
        mine = np.flatnonzero((frames.camera == number) & (distance >= near) & (distance <= far))
        local = np.einsum("fij,fj->fi", inverse(poses[mine])[:, :3, :3], place - poses[mine, :3, 3])
        found.append(mine[in_view(camera, local)[0]])
    return np.concatenate(found)
