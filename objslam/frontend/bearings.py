"""Turn boxes into bearing rays. The undistorted centre of a box gives the direction from the camera at a keyframe."""

import numpy as np

from objslam.config import Settings
from objslam.core.appearance.features import FeatureTable
from objslam.core.arrays import Bools, Floats, Floats32, Ints
from objslam.core.bodies.cut_boxes import CutBoxes
from objslam.core.camera import Camera, spoken_name, undistort
from objslam.core.diagnostics import Ledger
from objslam.core.noise import range_noise
from objslam.core.types import Detections, Keyframes, Log, Rays, label_table
from objslam.frontend.boxes.nested_boxes import PARTS, parts_of_boxes
from objslam.frontend.surface_ranges import half_widths, to_centres

CUT_OFF = "boxes cut off by the image's edge (rays.border, rays.border_share)"
"""The reason to drop a box that ends at the image's edge, because its centre is then wrong."""
MAX_OF_LABEL = 1000
"""The most boxes of one label in one frame that are used. A larger number takes more memory and time in a crowd."""


def build_rays(log: Log, keyframes: Keyframes, settings: Settings, ledger: Ledger) -> Rays:
    """Return one ray for each usable box of the keyframes, in the order of the keyframes. Ranges are NaN without depth.use.

    The ledger counts the other boxes. A box is not usable if its score is too low, if its centre is outside the image, or if
    the lens model has no inverse at its centre. A box that the image's edge cuts off is not usable either, unless
    rays.border is negative or the detections are `whole`. In each frame, the `MAX_OF_LABEL` boxes of a label with the
    highest scores are used. `Rays.cut` has the boxes that are unusable only because of the image's edge. The boxes of
    `parts_of_things` do not count.
    """
    label_names, _ = label_table([n for c in log.cameras if c.detections is not None for n in c.detections.label_names])
    place = {name: i for i, name in enumerate(label_names)}
    columns: list[tuple[Floats | Ints, ...]] = []
    cut: list[tuple[Floats | Ints, ...]] = []
    features: list[Floats32 | None] = []
    for index, camera_log in enumerate(log.cameras):
        detections, camera = camera_log.detections, camera_log.camera
        if detections is None:
            continue
        keyframe_of_frame = np.full(len(detections.frame_stamps), -1)
        mine = np.flatnonzero(keyframes.camera == index)
        keyframe_of_frame[keyframes.frame[mine]] = mine
        names = np.array([place[n] for n in detections.label_names], dtype=np.int64)
        boxes = _without_parts(detections.take(keyframe_of_frame[detections.frame] >= 0), camera, settings, ledger)
        measured = boxes.boxes, boxes.scores, boxes.stamps
        kept, directions, angle_sigma = box_rays(*measured, camera, settings, ledger, boxes.whole)
        off = boxes.take(_only_cut(boxes, camera, settings))
        cut.append((np.full(len(off), index), off.frame, names[off.label], off.boxes))
        boxes = boxes.take(kept)
        few = surest(boxes.frame, boxes.label, boxes.scores, camera, ledger)
        boxes, directions, angle_sigma = boxes.take(few), directions[few], angle_sigma[few]
        of_rays = (keyframe_of_frame[boxes.frame], directions, angle_sigma)
        corners, corner_sigma = _corner_rays(boxes, camera, settings, ledger)
        second = np.append(names, -1)[np.full(len(boxes), -1) if boxes.second is None else boxes.second]
        measures = boxes.depths, names[boxes.label], boxes.scores, boxes.boxes, boxes.track_ids, second
        columns.append((*of_rays, *measures, corners, corner_sigma))
        features.append(_features(boxes, features, camera, ledger))
    keyframe, direction, sigma, depth, label, score, box, track_id, second, corners, corner_sigma = (
        np.concatenate(c) for c in zip(*columns, strict=True)
    )
    seen = np.isfinite(corner_sigma).any()
    order = np.argsort(keyframe, kind="stable")
    if not settings.depth.use:
        depth = np.full(len(depth), np.nan)
    number, lenses = keyframes.camera[keyframe[order]], [one.camera for one in log.cameras]
    half = half_widths(box[order], direction[order], lenses, number, np.isfinite(corner_sigma[order]))
    ranges = (depth / direction[:, 2])[order] * to_centres(half, settings.depth.centre)
    feature, table = _table(features, [len(column[0]) for column in columns])
    range_sigma, range_bias = range_noise(ranges, half, number, lenses, settings)
    return Rays(
        keyframe=keyframe[order],
        direction=direction[order],
        sigma=sigma[order],
        range=ranges,
        range_sigma=range_sigma,
        range_bias=range_bias,
        label=label[order],
        score=score[order],
        box=box[order],
        track_id=track_id[order],
        label_names=label_names,
        corners=corners[order] if seen else None,
        corner_sigma=corner_sigma[order] if seen else None,
        cut=CutBoxes(*(np.concatenate(c) for c in zip(*cut, strict=True))),
        feature=None if feature is None else feature[order],
        feature_table=table,
        second=second[order] if (second >= 0).any() else None,
    )


def box_rays(
    boxes: Floats, scores: Floats, stamps: Floats | float, camera: Camera, settings: Settings, ledger: Ledger, whole: bool
) -> tuple[Ints, Floats, Floats]:
    """Return the indices (n,) of the usable boxes (M, 4) px of a camera, and the rays through their centres.

    A ray has a unit direction (n, 3) in the camera frame and a standard deviation (n,) rad. The ledger counts the other
    boxes. stamps: (M,) s, or one stamp for all boxes. whole: as in `types.Detections`.
    """
    kept = _usable(boxes, scores, stamps, camera, settings, ledger, whole)
    boxes = boxes[kept]
    directions, valid = undistort(camera, (boxes[:, :2] + boxes[:, 2:]) / 2)
    if not valid.all():
        bad = np.isin(np.arange(len(scores)), kept[~valid])
        ledger.drop("boxes where the lens model has no inverse", int((~valid).sum()), _where(camera, stamps, bad))
        kept, boxes, directions = kept[valid], boxes[valid], directions[valid]
    return kept, directions, _angle_sigma(camera, directions, boxes, settings)


def _corner_rays(boxes: Detections, camera: Camera, settings: Settings, ledger: Ledger) -> tuple[Floats, Floats]:
    """Return unit directions (M, 4, 3) to the corners of fiducials in the camera frame, and their sigma (M,), rad.

    Both are NaN for a box without corners, and for a fiducial with a corner where the lens model has no inverse.
    """
    directions, sigma = np.full((len(boxes), 4, 3), np.nan), np.full(len(boxes), np.nan)
    if boxes.corners is None or not settings.tags.use:
        return directions, sigma
    known = np.flatnonzero(np.isfinite(boxes.corners[:, 0, 0]))
    found, valid = undistort(camera, boxes.corners[known].reshape(-1, 2))
    whole = valid.reshape(-1, 4).all(axis=1)
    lost = "corners of fiducials where the lens model has no inverse (their centres are used)"
    ledger.drop(lost, int((~whole).sum()), spoken_name(camera.name))
    directions[known[whole]] = found.reshape(-1, 4, 3)[whole]
    middle = directions[known[whole]].mean(axis=1)
    middle /= np.linalg.norm(middle, axis=1, keepdims=True)
    sigma[known[whole]] = _radians(camera, middle, np.full(len(middle), settings.tags.corner_sigma))
    return directions, sigma


def _features(boxes: Detections, before: list[Floats32 | None], camera: Camera, ledger: Ledger) -> Floats32 | None:
    """Return the appearance vectors (M, D) of boxes, None if the boxes have none that can be used.

    Vectors of all cameras are compared, so their lengths must be equal. The first camera with vectors sets the length. The
    ledger counts vectors of any other length.
    """
    if boxes.features is None:
        return None
    length = next((one.shape[1] for one in before if one is not None), boxes.features.shape[1])
    if boxes.features.shape[1] == length:
        return boxes.features
    reason = "features of another length than in the first camera (these boxes get none)"
    ledger.drop(reason, int((~np.isnan(boxes.features[:, 0])).sum()), spoken_name(camera.name))
    return None


def _table(features: list[Floats32 | None], counts: list[int]) -> tuple[Ints | None, FeatureTable | None]:
    """Return the row of each ray (R,) in a table of all vectors, -1 without a vector, and the table. Both are None without
    vectors.

    features: the vectors of the boxes of each camera. counts: the number of boxes of each camera.
    """
    row, rows, at = np.full(sum(counts), -1, dtype=np.int64), list[Floats32](), 0
    for vectors, count in zip(features, counts, strict=True):
        if vectors is not None:
            known = np.flatnonzero(~np.isnan(vectors[:, 0]))
            row[at + known] = sum(map(len, rows)) + np.arange(len(known))
            rows.append(vectors[known])
        at += count
    return (row, FeatureTable(np.concatenate(rows))) if (row >= 0).any() else (None, None)


def parts_of_things(
    boxes: Floats,
    frame: Ints,
    label: Ints,
    scores: Floats,
    stamps: Floats | float,
    camera: Camera,
    settings: Settings,
    ledger: Ledger,
    whole: bool,
) -> Bools:
    """Return which boxes (M, 4) px of a camera show the thing of another box (`parts_of_boxes`). The ledger counts these
    boxes.

    A box with a low score is no reason to drop another box. frame, label, scores: (M,) of each box. stamps: (M,) s, or one
    stamp for all boxes. whole: as in `types.Detections`.
    """
    sure = np.flatnonzero(scores >= settings.rays.min_score)
    cut = np.zeros(len(sure), dtype=bool)
    if settings.rays.border >= 0 and not whole:
        cut = np.asarray(cut_edges(boxes[sure], camera, settings).any(axis=1))
    part = np.zeros(len(boxes), dtype=bool)
    part[sure] = parts_of_boxes(boxes[sure], frame[sure], label[sure], scores[sure], cut)
    ledger.drop(PARTS, int(part.sum()), _where(camera, stamps, part), of=len(boxes))
    return part


def surest(frame: Ints, label: Ints, scores: Floats, camera: Camera, ledger: Ledger) -> Ints:
    """Return the increasing indices of the boxes that are used: for each label in each frame the `MAX_OF_LABEL` best.

    frame, label, scores: (M,) of each box. Of equal scores, the first box is better. The ledger counts the other boxes.
    """
    count = len(frame)
    if count <= MAX_OF_LABEL:
        return np.arange(count)
    order = np.lexsort((-scores, label, frame))
    first = np.append(True, (np.diff(frame[order]) != 0) | (np.diff(label[order]) != 0))
    rank = np.arange(count) - np.flatnonzero(first)[np.cumsum(first) - 1]
    kept = np.sort(order[rank < MAX_OF_LABEL])
    ledger.drop(
        f"boxes beyond the {MAX_OF_LABEL} surest of their label in a frame", count - len(kept), spoken_name(camera.name)
    )
    return kept


def _usable(
    boxes: Floats, scores: Floats, stamps: Floats | float, camera: Camera, settings: Settings, ledger: Ledger, whole: bool
) -> Ints:
    wrong = _wrong(boxes, scores, camera, settings)
    if settings.rays.border >= 0 and not whole:
        wrong[CUT_OFF] = np.asarray(cut_edges(boxes, camera, settings).any(axis=1))
    left = np.ones(len(boxes), dtype=bool)
    for reason, bad in wrong.items():
        bad = left & bad
        ledger.drop(reason, int(bad.sum()), _where(camera, stamps, bad), of=len(boxes))
        left &= ~bad
    return np.flatnonzero(left)


def _wrong(boxes: Floats, scores: Floats, camera: Camera, settings: Settings) -> dict[str, Bools]:
    """Return for each reason which boxes (M, 4) are unusable. A box that the image's edge cuts off is judged like others."""
    centre = (boxes[:, :2] + boxes[:, 2:]) / 2
    return {
        f"boxes below rays.min_score {settings.rays.min_score:g}": ~(scores >= settings.rays.min_score),
        "boxes with their centre outside the image": np.asarray(~((centre >= 0) & (centre <= camera.size)).all(axis=1)),
    }


def cut_edges(boxes: Floats, camera: Camera, settings: Settings) -> Bools:
    """Return which edges (M, 4) of boxes (M, 4), px, are near to the image's edge, so that the image may cut off the box."""
    low, high = boxes[:, :2], boxes[:, 2:]
    border = np.maximum(settings.rays.border, settings.rays.border_share * (high - low))
    return np.concatenate([low <= border, high >= camera.size - 1 - border], axis=1)


def _without_parts(boxes: Detections, camera: Camera, settings: Settings, ledger: Ledger) -> Detections:
    """Return the boxes without those of `parts_of_things`."""
    columns = boxes.boxes, boxes.frame, boxes.label, boxes.scores, boxes.stamps
    part = parts_of_things(*columns, camera, settings, ledger, boxes.whole)
    return boxes.take(np.flatnonzero(~part)) if part.any() else boxes


def _only_cut(boxes: Detections, camera: Camera, settings: Settings) -> Ints:
    """Return the increasing indices of the boxes that are unusable only because the image's edge cuts them off."""
    if settings.rays.border < 0 or boxes.whole:
        return np.zeros(0, dtype=np.int64)
    wrong = np.any(list(_wrong(boxes.boxes, boxes.scores, camera, settings).values()), axis=0)
    found = np.flatnonzero(cut_edges(boxes.boxes, camera, settings).any(axis=1) & ~wrong)
    return found[surest(boxes.frame[found], boxes.label[found], boxes.scores[found], camera, Ledger())]


def _where(camera: Camera, stamps: Floats | float, bad: Bools) -> str | None:
    """Return the camera and the stamp of the first bad box, None if all boxes are good."""
    if not bad.any():
        return None
    first = float(np.broadcast_to(stamps, len(bad))[np.argmax(bad)])
    return f"{spoken_name(camera.name)}, stamp {first:.3f}"


def _angle_sigma(camera: Camera, directions: Floats, boxes: Floats, settings: Settings) -> Floats:
    """Return the standard deviations (n,), rad, of rays in unit directions (n, 3) through the centres of boxes (n, 4)."""
    size = np.maximum(boxes[:, 2:] - boxes[:, :2], 0.0)
    pixels = np.hypot(settings.rays.pixel_sigma, settings.rays.box_sigma * np.sqrt(size[:, 0] * size[:, 1]))
    return _radians(camera, directions, pixels)


def _radians(camera: Camera, directions: Floats, pixels: Floats) -> Floats:
    """Convert distances (n,), px, in the image at unit directions (n, 3) to angles (n,), rad, between rays."""
    # If a ray turns by 1 rad, its pinhole image moves by f / cos(a)^2 along the radius and by f / cos(a) across it, where a
    # is the angle off the axis. The geometric mean gives one sigma for the ray. A fisheye image moves by f everywhere.
    if camera.fisheye:
        return pixels / camera.focal
    return pixels / camera.focal * directions[:, 2] ** 1.5
