"""From boxes to bearing rays: each box's centre, undistorted, as a direction from its keyframe's camera."""

from __future__ import annotations

import numpy as np

from objslam.config import Settings
from objslam.ledger import Ledger
from objslam.types import Bools, Camera, Floats, Ints, Keyframes, Log, Rays, label_table


def undistort(camera: Camera, pixels: Floats) -> tuple[Floats, Bools]:
    """Unit directions (N, 3) in the camera frame of raw pixels (N, 2), and which of them (N,) the lens model can invert.

    plumb_bob and rational_polynomial by cv2.undistortPoints, equidistant (Kannala-Brandt) by cv2.fisheye.undistortPoints,
    each iterated to the end; a pixel that does not come back to itself within 0.1 px has no ray.
    """
    import cv2

    if len(pixels) == 0:
        return np.zeros((0, 3)), np.zeros(0, dtype=bool)
    if camera.distortion_model != "equidistant" and not camera.distortion.any():
        finite: Bools = np.asarray(np.isfinite(pixels).all(axis=1))
        pixels = pixels if finite.all() else np.where(finite[:, None], pixels, 0.0)
        straight = pixels @ camera.inverse_matrix[:, :2].T + camera.inverse_matrix[:, 2]
        return straight / np.linalg.norm(straight, axis=1, keepdims=True), finite
    points = np.ascontiguousarray(pixels, dtype=np.float64)[:, None, :]
    criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 100, 1e-12)
    if camera.distortion_model == "equidistant":
        # fisheye.undistortPoints works up to 90 degrees off the axis only: that is where a direction has no z = 1 form
        flat = cv2.fisheye.undistortPoints(points, camera.matrix, camera.distortion, criteria=criteria)[:, 0]
        again = cv2.fisheye.distortPoints(flat[:, None], camera.matrix, camera.distortion)[:, 0]
    else:
        flat = cv2.undistortPoints(points, camera.matrix, camera.distortion, criteria=criteria)[:, 0]
        homogeneous = np.column_stack([flat, np.ones(len(flat))])
        again = cv2.projectPoints(homogeneous, np.zeros(3), np.zeros(3), camera.matrix, camera.distortion)[0][:, 0]
    with np.errstate(invalid="ignore", over="ignore"):
        valid = np.isfinite(flat).all(axis=1) & (np.linalg.norm(again - pixels, axis=1) < 0.1)
    directions = np.column_stack([np.where(valid[:, None], flat, 0.0), np.ones(len(flat))])
    return directions / np.linalg.norm(directions, axis=1, keepdims=True), valid


def project(camera: Camera, points: Floats) -> Floats:
    """Raw (distorted) pixels (N, 2) of points (N, 3), m, in the camera frame, in front of the camera."""
    import cv2

    if len(points) == 0:
        return np.zeros((0, 2))
    still = np.zeros(3)
    if camera.distortion_model == "equidistant":
        pixels, _ = cv2.fisheye.projectPoints(points[:, None], still, still, camera.matrix, camera.distortion)
    elif camera.distortion.any():
        pixels, _ = cv2.projectPoints(points, still, still, camera.matrix, camera.distortion)
    else:
        pixels = (points @ camera.matrix.T)[:, :2] / points[:, 2:]
    return np.asarray(pixels, dtype=np.float64).reshape(-1, 2)


def build_rays(log: Log, keyframes: Keyframes, settings: Settings, ledger: Ledger) -> Rays:
    """One ray for each usable box of the keyframes, in their order.

    Boxes below the score limit, with a centre outside the image, cut off by its edge (unless the detections are `whole`), or
    where the lens model has no inverse are dropped and counted.
    """
    label_names, _ = label_table([n for c in log.cameras if c.detections is not None for n in c.detections.label_names])
    place = {name: i for i, name in enumerate(label_names)}
    columns: list[tuple[Floats | Ints, ...]] = []
    for index, camera_log in enumerate(log.cameras):
        detections, camera = camera_log.detections, camera_log.camera
        if detections is None:
            continue
        keyframe_of_frame = np.full(len(detections.frame_stamps), -1)
        mine = np.flatnonzero(keyframes.camera == index)
        keyframe_of_frame[keyframes.frame[mine]] = mine
        boxes = detections.take(keyframe_of_frame[detections.frame] >= 0)
        kept, directions, angle_sigma = box_rays(boxes.boxes, boxes.scores, camera, settings, ledger, boxes.whole)
        boxes = boxes.take(kept)
        names = np.array([place[n] for n in detections.label_names], dtype=np.int64)
        columns.append(
            (
                keyframe_of_frame[boxes.frame],
                directions,
                angle_sigma,
                boxes.depths,
                names[boxes.label],
                boxes.scores,
                boxes.boxes,
                boxes.track_ids,
            )
        )
    keyframe, direction, sigma, depth, label, score, box, track_id = (np.concatenate(c) for c in zip(*columns, strict=True))
    order = np.argsort(keyframe, kind="stable")
    if not settings.depth.use:
        depth = np.full(len(depth), np.nan)
    ranges = (depth / direction[:, 2])[order]
    return Rays(
        keyframe=keyframe[order],
        direction=direction[order],
        sigma=sigma[order],
        range=ranges,
        range_sigma=settings.depth.sigma + settings.depth.sigma_per_m * ranges,
        label=label[order],
        score=score[order],
        box=box[order],
        track_id=track_id[order],
        label_names=label_names,
    )


def box_rays(
    boxes: Floats, scores: Floats, camera: Camera, settings: Settings, ledger: Ledger, whole: bool
) -> tuple[Ints, Floats, Floats]:
    """Which boxes (M, 4) of a camera are usable (n,), their unit directions (n, 3) in its frame and sigmas (n,), rad.

    The rest is counted. whole: as `types.Detections` has it.
    """
    kept = _usable(boxes, scores, camera, settings, ledger, whole)
    boxes = boxes if len(kept) == len(boxes) else boxes[kept]
    directions, valid = undistort(camera, (boxes[:, :2] + boxes[:, 2:]) / 2)
    if not valid.all():
        ledger.drop("boxes where the lens model has no inverse", int((~valid).sum()), f"camera {camera.name}")
        kept, boxes, directions = kept[valid], boxes[valid], directions[valid]
    return kept, directions, _angle_sigma(camera, directions, _centre_sigma(boxes, settings))


def _usable(boxes: Floats, scores: Floats, camera: Camera, settings: Settings, ledger: Ledger, whole: bool) -> Ints:
    of, size = settings.rays, camera.size
    low, high = boxes[:, :2], boxes[:, 2:]
    centre = (low + high) / 2
    wrong = {
        f"boxes below rays.min_score {of.min_score:g}": ~(scores >= of.min_score),
        "boxes with their centre outside the image": ~((centre >= 0) & (centre <= size)).all(axis=1),
    }
    if of.border >= 0 and not whole:
        border = np.maximum(of.border, of.border_share * (high - low))
        cut = (low <= border) | (high >= size - 1 - border)
        wrong["boxes cut off by the image's edge (rays.border)"] = cut.any(axis=1)
    keep = ~np.logical_or.reduce(list(wrong.values()))
    if not keep.all():
        left = np.ones(len(boxes), dtype=bool)
        for reason, bad in wrong.items():
            ledger.drop(reason, int((left & bad).sum()), f"camera {camera.name}")
            left &= ~bad
    return np.flatnonzero(keep)


def _centre_sigma(boxes: Floats, settings: Settings) -> Floats:
    """One standard deviation (M,), px, of the centres of boxes (M, 4)."""
    size = np.maximum(boxes[:, 2:] - boxes[:, :2], 0.0)
    return np.hypot(settings.rays.pixel_sigma, settings.rays.box_sigma * np.sqrt(size[:, 0] * size[:, 1]))


def _angle_sigma(camera: Camera, directions: Floats, pixel_sigma: Floats) -> Floats:
    # A small angle at `a` off the axis moves a pinhole image by f / cos(a)^2 along the radius and f / cos(a) across it: the
    # (geometric) mean of the two keeps one sigma a ray. A fisheye keeps f throughout.
    if camera.distortion_model == "equidistant":
        return pixel_sigma / camera.focal
    cos = directions[:, 2]
    return pixel_sigma / camera.focal * cos**1.5


def angles_off(origins: Floats, directions: Floats, points: Floats) -> Floats:
    """The angle (R,), rad in [0, pi], between each ray, (R, 3) and (R, 3) unit, and the way to its point (R, 3)."""
    to = points - origins
    return np.arctan2(np.linalg.norm(np.cross(to, directions), axis=1), np.einsum("ri,ri->r", to, directions))
