"""Find in which frames each object should be detected, and in which it is detected."""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from objslam.association.observations import MIN_DEPTH, Observations
from objslam.config import Settings
from objslam.core.arrays import Bools, Floats, Ints
from objslam.core.bodies.cut_boxes import CutBoxes
from objslam.core.camera import Camera, depths, in_view
from objslam.core.ground.flattening import LEVEL, raised_points
from objslam.core.object_map import SeenFrom
from objslam.core.rotation import dots
from objslam.core.statistics import distinct, grouped_median, grouped_quantile, grouped_quantiles, grouped_sums
from objslam.core.types import Keyframes

_WHOLE = 0.25
"""The share of a camera's boxes at the image's edge that must reach beyond it, if the boxes go around whole objects. The
share was 0.5 in three recordings of such boxes. With a larger value, the misses of such detectors count less often. With a
smaller one, a few wrong boxes change what counts as a miss."""
_PAIRS_AT_ONCE = 1 << 18  # The most pairs of an object and a frame processed together, which fit into the processor's cache.
_USUAL_DISTANCES = (0.02, 0.98)
"""The quantiles of a class's detection distances. Outside them, a miss means nothing. A wider range counts more misses."""
_CORE_SHARE = 0.8
"""The share of a class's boxes from which its usual distances come. The objects with the most boxes are taken. Objects with
few boxes may be phantoms. A larger share lets phantoms widen the usual distances."""
_FRONT_SHARE = 0.95
"""The least share of an object's boxes from one half space with which the object has a front. A larger share gives fewer
objects a front."""
_CLOSER = (0.3, 0.1)
"""The least distance from an occluder to the object behind it: in m, and as a share of the object's distance. The larger one
counts. Half the sum of the two sizes replaces the first value if this half sum is larger, because on a table a thing may
hide its neighbour. Larger values hide fewer objects."""
_SAME_SIDE = np.cos(np.radians(45.0))
"""The cosine of the largest angle between two views of one side of an object. A smaller cosine counts more frames."""
_FILLED = 0.6  # The share of a box's width and height that its object certainly fills. A larger value occludes more.


@dataclass(frozen=True)
class CameraFrames:
    """The observed frames. stamps: (F,) s. cameras: all cameras. camera: (F,) the camera of each frame. map_T_camera: (F, 4,
    4). A box counts if it is at least `margin` px, and at least `margin_share` of its size, away from the image edge. With a
    negative margin, each box counts. drift: (F, 6, 6) as in `Keyframes`, None if the poses do not drift. cut: the boxes in
    these frames that the image's edge cuts off, None if unknown. Their `frame` is the index of an observed frame. localized:
    whether a localisation gives the poses, so that a place keeps its position in the map when the robot comes back.
    """

    stamps: Floats
    cameras: tuple[Camera, ...]
    camera: Ints
    map_T_camera: Floats
    margin: float
    margin_share: float
    drift: Floats | None = None
    cut: CutBoxes | None = None
    localized: bool = True

    @cached_property
    def solid_angle(self) -> float:
        """Mean solid angle (sr) of a frame."""
        each = np.array([camera.solid_angle for camera in self.cameras])
        return float(each[self.camera].mean()) if len(self.camera) else 1.0


def frames_of(
    keyframes: Keyframes,
    order: Ints,
    cameras: tuple[Camera, ...],
    map_T_camera: Floats,
    settings: Settings,
    *,
    drifts: bool = False,
    cut: CutBoxes | None = None,
) -> CameraFrames:
    """Convert keyframes to observed frames.

    order: (K,) the keyframes, in the order of the frames. map_T_camera: (K, 4, 4) the camera poses of the keyframes. drifts:
    whether these poses drift as the odometry does. cut: as in `Rays`.
    """
    poses, margins = map_T_camera[order], (settings.rays.border, settings.rays.border_share)
    drift = keyframes.drift[order] if drifts and keyframes.drift is not None else None
    camera, frame = keyframes.camera[order], keyframes.frame[order]
    cut = None if cut is None else _in_frames(cut, camera, frame)
    localized = keyframes.localized_every > 0
    return CameraFrames(keyframes.stamps[order], cameras, camera, poses, *margins, drift, cut, localized)


def _in_frames(cut: CutBoxes, camera: Ints, frame: Ints) -> CutBoxes:
    """Return the cut off boxes of observed frames, sorted by frame. camera, frame: (F,) as in `Keyframes`."""
    width = int(max(frame.max(initial=0), cut.frame.max(initial=0))) + 1
    key, wanted = camera * width + frame, cut.camera * width + cut.frame
    order = np.argsort(key, kind="stable")
    at = np.minimum(np.searchsorted(key[order], wanted), max(len(key) - 1, 0))
    found = np.flatnonzero(key[order][at] == wanted) if len(key) else np.zeros(0, dtype=np.int64)
    of = order[at[found]] if len(key) else found
    return replace(cut.take(found), frame=of).take(np.argsort(of, kind="stable"))


@dataclass(frozen=True)
class DetectionHistory:
    """V pairs of an object and a frame in which it is or should be detected, sorted by object, then by frame.

    object, frame, detected: (V,) of each pair. inside: (N,) number of frames whose image contains each object's box, and
    whose camera is near enough to detect it: within the usual distances of the class, or no farther than the object's
    farthest box.
    """

    object: Ints
    frame: Ints
    detected: Bools
    inside: Ints

    @cached_property
    def expected(self) -> Ints:
        """Number (N,) of frames in which each object is or should be detected."""
        return np.bincount(self.object, minlength=len(self.inside))

    @cached_property
    def seen(self) -> Ints:
        """Number (N,) of frames in which each object is detected."""
        return np.bincount(self.object[self.detected], minlength=len(self.inside))


def detection_history(
    obs: Observations, matched: Ints, position: Floats, label: Ints, view: CameraFrames
) -> DetectionHistory:
    """Return in which frames the objects are or should be detected.

    An object should be detected under four conditions. Its box lies in the image, and no cut off box of its label is there.
    Its distance is in the usual range of its class, extended to the median distance of its own boxes. No closer box hides
    it. The camera sees its front, if it has one. matched: (R,) the object of each observation, -1 for none. position, label:
    (N, 3) m and (N,) of the objects, in the world of the observations.
    """
    if obs.scale != LEVEL:
        position, obs = raised_points(position, obs.scale), replace(obs, origin=raised_points(obs.origin, obs.scale))
    count = len(position)
    held = np.flatnonzero(matched >= 0)
    index = matched[held]
    distance, total = np.full(len(obs.frame), np.nan), len(view.camera)
    # NumPy takes rows in a seventh of the time of an index, and is slow if the last axis is short.
    toward = obs.origin.T.take(held, axis=1) - position.T.take(index, axis=1)
    distance[held] = length = np.sqrt(dots(toward, toward))
    extent = np.nan_to_num(grouped_median(obs.size.take(held, axis=0) * length[:, None], index, count))
    near, far = _usual_ranges(length, index, label)
    own, furthest = (np.nan_to_num(quantile) for quantile in grouped_quantiles(length, index, count, (0.5, 1.0)))
    near, far = np.minimum(own, near[label]), np.maximum(own, far[label])
    reach = np.maximum(furthest, far)
    obj, frame, away, pixel = _in_images(position, extent, reach, obs, view)
    inside = np.bincount(obj, minlength=count)
    usual = (away >= near[obj]) & (away <= far[obj])
    usual &= _from_the_front(toward / np.maximum(length, 1e-9), index, position, obj, frame, view.map_T_camera)
    some = usual.nonzero()[0]
    obj, frame, away, pixel = obj.take(some), frame.take(some), away.take(some), pixel.take(some, axis=0)
    reach = np.where(np.isfinite(obs.range), obs.range, distance)
    clear = ~_hidden(frame, away, pixel, obs, reach, _mean_size(extent[obj]))
    if view.cut is not None:
        clear &= ~_cut_off(frame, label[obj], pixel, view.cut)
    there = index * total + obs.frame[held]
    key = distinct(np.concatenate([obj[clear] * total + frame[clear], there]))
    detected = np.zeros(len(key), dtype=bool)
    detected[np.searchsorted(key, there)] = True
    return DetectionHistory(*np.divmod(key, total), detected, inside)


def count_looks(
    position: Floats, extent: Floats, known: list[SeenFrom], view: CameraFrames, obs: Observations, distance: Floats
) -> Ints:
    """Return in how many frames (N,) each object of a map should be detected if it is at its position (N, 3) m.

    An object should be detected under four conditions. Its box lies in the image. Its distance is one at which it was
    detected before. The camera sees a side that was detected before. No closer box covers it.

    extent: (N, 2) m, the width and height of each object, NaN where unknown. known: from where each object was detected. Its
    sides are in the frame of the positions. obs: the boxes in the frames of `view`. distance: (R,) m, from the camera to the
    object of each of these boxes, NaN where unknown.
    """
    near, far = (np.array([getattr(one, name) for one in known]) for name in ("near", "far"))
    extent = np.nan_to_num(extent)
    obj, frame, away, pixel = _in_images(position, extent, far, obs, view)
    usual = away >= near[obj]
    usual &= _from_known_sides(obj, view.map_T_camera[frame, :3, 3] - position[obj], known)
    obj, frame, away, pixel = obj[usual], frame[usual], away[usual], pixel[usual]
    clear = ~_hidden(frame, away, pixel, obs, distance, _mean_size(extent[obj]))
    return np.bincount(obj[clear], minlength=len(position))


def _from_known_sides(obj: Ints, toward: Floats, known: list[SeenFrom]) -> Bools:
    """Return whether each camera, at `toward` (V, 3) m from its object (V,), sees a side that was detected before."""
    toward = toward / np.maximum(np.linalg.norm(toward, axis=1, keepdims=True), 1e-9)
    order = np.argsort(obj, kind="stable")
    bounds = np.searchsorted(obj[order], np.arange(len(known) + 1))
    seen = np.zeros(len(obj), dtype=bool)
    for j, one in enumerate(known):
        mine = order[bounds[j] : bounds[j + 1]]
        if len(mine) and len(one.sides):
            seen[mine] = (toward[mine] @ one.sides.T).max(axis=1) >= _SAME_SIDE
    return seen


def _usual_ranges(distance: Floats, index: Ints, label: Ints) -> list[Floats]:
    """Return the least and the greatest usual distance (C,) of each class, from the distances (P,) m of boxes.

    Only the objects with the most boxes count (`_CORE_SHARE`). index: (P,) the object of each box. label: (N,) of the
    objects.
    """
    number = np.bincount(index, minlength=len(label))
    order = np.lexsort((-number, label))
    before = np.cumsum(number[order]) - number[order]
    before -= before[np.searchsorted(label[order], label[order])]
    core = np.zeros(len(label), dtype=bool)
    core[order] = before <= _CORE_SHARE * np.bincount(label, number)[label[order]]
    core_box = core[index]
    classes = int(label.max(initial=-1)) + 1
    return grouped_quantiles(distance[core_box], label[index[core_box]], classes, _USUAL_DISTANCES)


def _from_the_front(toward: Floats, index: Ints, position: Floats, obj: Ints, frame: Ints, map_T_camera: Floats) -> Bools:
    """Return whether the camera of each frame (V,) sees the front of its object (V,). A screen, for example, has a front.

    An object has a front if nearly all its boxes come from one half space. Misses from behind then mean nothing. toward: (3,
    P) unit, from the object of each box to the camera. index: (P,) the object of each box. map_T_camera: (F, 4, 4) of the
    frames.
    """
    count, seen = len(position), np.ones(len(obj), dtype=bool)
    front = grouped_sums(toward.T, index, count).T
    facing = dots(toward, front.take(index, axis=1))
    one_sided = np.nan_to_num(grouped_quantile(facing, index, count, 1 - _FRONT_SHARE)) >= 0
    asked = np.flatnonzero(one_sided[obj])
    obj, frame, origin = obj[asked], frame[asked], map_T_camera[:, :3, 3].T
    ahead = sum(o.take(frame) * f.take(obj) for o, f in zip(origin, front, strict=True))
    seen[asked] = ahead >= dots(position.T, front).take(obj)
    return seen


def _in_images(
    position: Floats, extent: Floats, reach: Floats, obs: Observations, view: CameraFrames
) -> tuple[Ints, Ints, Floats, Floats]:
    """Return what `_in_image` returns, for all frames. extent: (N, 2) m. obs: shows which boxes go around whole objects."""
    whole, step = _whole_boxes(obs, view), max(1, _PAIRS_AT_ONCE // max(len(position), 1))
    pairs = [(np.zeros(0, dtype=np.int64), np.zeros(0, dtype=np.int64), np.zeros(0), np.zeros((0, 2)))]
    for number, camera in enumerate(view.cameras):
        frames, boxed = np.flatnonzero(view.camera == number), None if whole[number] else extent
        for begin in range(0, len(frames), step):
            pairs.append(_in_image(position, boxed, reach, camera, frames[begin : begin + step], view))
    obj, frame, away, pixel = (np.concatenate(column) for column in zip(*pairs, strict=True))
    return obj, frame, away, pixel


def _in_image(
    position: Floats, extent: Floats | None, reach: Floats, camera: Camera, frames: Ints, view: CameraFrames
) -> tuple[Ints, Ints, Floats, Floats]:
    """Return object (V,), frame (V,), distance (V,) m and pixel (V, 2) of each object box inside an image.

    extent: (N, 2) m, None if only the centre of a box must be inside. reach: (N,) m, the distance up to which each object
    counts.
    """
    poses = view.map_T_camera[frames]
    centre = poses[:, :3, 3].mean(axis=0)
    point, origin, ahead = position - centre, (poses[:, :3, 3] - centre).T, poses[:, :3, 2].T
    one, share = np.ones((len(point), 1)), np.cos(camera.view_angle) ** 2
    depth = np.hstack([point, one]) @ np.vstack([ahead, -dots(ahead, origin)])
    rows = np.hstack([-2 * point, one, (point**2).sum(axis=1)[:, None]])
    distance2 = rows @ np.vstack([origin, dots(origin, origin), np.ones(len(frames))])
    # Most objects are outside the cone of view and need no projection.
    near = (distance2 > MIN_DEPTH**2) & (distance2 <= (reach[:, None] + 1e-6) ** 2) & (depth > 0)
    depth *= depth
    distance2 *= share
    near &= depth >= distance2
    n, f = np.divmod(np.flatnonzero(near), len(frames))
    # The axis of x, y and z comes first, because NumPy is slow if the last axis is short.
    apart = point.T.take(n, axis=1) - origin.take(f, axis=1)
    local = np.stack([dots(axis.T.take(f, axis=1), apart) for axis in np.moveaxis(poses[:, :3, :3], 2, 0)], axis=1)
    away = np.sqrt(np.einsum("vi,vi->v", local, local))
    half = np.zeros((len(n), 2))
    if view.margin >= 0 and extent is not None:
        box = (extent * np.diag(camera.matrix)[:2]).take(n, axis=0) / depths(camera, local)[:, None]
        half = box / 2 + np.maximum(view.margin, view.margin_share * box)
    inside, pixel = in_view(camera, local, half, camera.size - 1 - half)
    return n[inside], frames[f[inside]], away[inside], pixel


def _whole_boxes(obs: Observations, view: CameraFrames) -> Bools:
    """Return which cameras (C,) have boxes that go around whole objects, even if the image's edge cuts an object off.

    Such boxes reach beyond the image. A detector of the poses of objects draws them, for example. It should find an object
    wherever its centre is in the image. A few boxes beyond the edge are not enough, because any detector may draw a few.
    """
    sizes = np.array([camera.size for camera in view.cameras]).reshape(-1, 2)
    camera, low, high = view.camera[obs.frame], obs.box[:, :2], obs.box[:, 2:]
    margin = np.maximum(view.margin, view.margin_share * (high - low))
    last = sizes[camera] - 1
    beyond = ((low < -margin) | (high > last + margin)).any(axis=1)
    at_edge = ((low <= margin) | (high >= last - margin)).any(axis=1)
    reaching, whole = (np.bincount(camera[some], minlength=len(sizes)) for some in (at_edge, beyond))
    return np.asarray(whole > _WHOLE * reaching)


def _mean_size(extent: Floats) -> Floats:
    """Return the geometric mean (n,) m of widths and heights (n, 2)."""
    return np.sqrt(extent.prod(axis=1))


def _cut_off(frame: Ints, label: Ints, pixel: Floats, cut: CutBoxes) -> Bools:
    """Return whether a cut off box of the same label contains each pixel (V, 2). frame, label: (V,) the frame and the label
    of each pixel. cut: sorted by frame."""
    begin, end = (np.searchsorted(cut.frame, frame, side=side) for side in ("left", "right"))
    inside = np.zeros(len(frame), dtype=bool)
    for k in range(int((end - begin).max(initial=0))):  # Each step checks the k-th box of all frames that have one.
        rows = np.flatnonzero(end - begin > k)
        box = cut.box[begin[rows] + k]
        over = ((pixel[rows] >= box[:, :2]) & (pixel[rows] <= box[:, 2:])).all(axis=1)
        inside[rows] |= over & (cut.label[begin[rows] + k] == label[rows])
    return inside


def _hidden(frame: Ints, distance: Floats, pixel: Floats, obs: Observations, reach: Floats, size: Floats) -> Bools:
    """Return whether the box of a closer object covers each pixel (V, 2).

    frame, distance: (V,) the frame and the distance, m, of the object at each pixel. reach: (R,) m, the distance of the
    object of each observation, NaN if unknown. size: (V,) m, of the object at each pixel, 0 if unknown.
    """
    hidden = np.zeros(len(frame), dtype=bool)
    useful = np.flatnonzero(np.isfinite(reach))
    frames = np.arange(int(max(frame.max(initial=0), obs.frame.max(initial=0))) + 2)
    start = np.searchsorted(obs.frame[useful], frames)
    begin, end = start[frame], start[frame + 1]
    low, high = obs.box[:, :2].T, obs.box[:, 2:].T
    middle, half = (low + high) / 2, _FILLED * (high - low) / 2
    thick = _mean_size(obs.size) * np.nan_to_num(reach)
    number = end - begin
    most = np.argsort(-number, kind="stable")
    fewer = -number[most]
    for k in range(int(number.max(initial=0))):  # Each step checks the k-th box of all frames that have one.
        rows = most[: np.searchsorted(fewer, -k)]
        box = useful.take(begin.take(rows) + k)
        closer = np.flatnonzero(reach.take(box) < (1 - _CLOSER[1]) * distance.take(rows))
        rows, box = rows.take(closer), box.take(closer)
        for axis in (0, 1):
            over = np.flatnonzero(np.abs(pixel[:, axis].take(rows) - middle[axis].take(box)) <= half[axis].take(box))
            rows, box = rows.take(over), box.take(over)
        own = size.take(rows)
        apart = np.where(own > 0, np.minimum((thick[box] + own) / 2, _CLOSER[0]), _CLOSER[0])
        hidden[rows] |= reach[box] < distance[rows] - apart
    return hidden
