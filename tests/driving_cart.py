"""Boxes of a cart that drives, in a simulated log."""

from dataclasses import replace

import numpy as np

from objslam.core.camera import project
from objslam.core.geometry import interpolate
from objslam.core.types import Log


def with_cart_that_drives(log: Log, seed: int, label: str = "cart") -> Log:
    """The log with boxes of a cart, 0.5 m long, wide and high, that drives to and fro between places that chance picks."""
    camera, rng = log.cameras[0], np.random.default_rng(seed)
    found, path = camera.detections, log.truth.trajectory
    poses, _ = interpolate(path.stamps, path.poses, found.frame_stamps, 1.0)
    places = rng.uniform(-2.5, 2.5, (100, 2))
    way = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(places, axis=0), axis=1)))
    driven = 0.8 * (found.frame_stamps - found.frame_stamps[0])
    frame, boxes = [], []
    for number, (pose, far) in enumerate(zip(poses, driven, strict=True)):
        middle = [np.interp(far % way[-1], way, places[:, axis]) for axis in (0, 1)]
        corners = [(middle[0] + x, middle[1] + y, z) for x in (-0.25, 0.25) for y in (-0.25, 0.25) for z in (0.0, 0.5)]
        map_T_camera = pose @ camera.camera.base_T_camera
        seen = (np.array(corners) - map_T_camera[:3, 3]) @ map_T_camera[:3, :3]
        if (seen[:, 2] < 0.5).any():
            continue
        pixels = project(camera.camera, seen)
        size = camera.camera.width, camera.camera.height
        box = np.concatenate([pixels.min(axis=0), pixels.max(axis=0)]) + rng.normal(0, 1, 4)
        if (box[:2] > 0).all() and (box[2:] < size).all():
            frame.append(number)
            boxes.append(box)
    order = np.argsort(np.concatenate([found.frame, frame]), kind="stable")
    more = {
        "frame": np.array(frame, dtype=np.int64),
        "boxes": np.array(boxes),
        "label": np.full(len(frame), len(found.label_names)),
        "scores": np.full(len(frame), 0.9),
        "depths": np.full(len(frame), np.nan),
        "track_ids": np.full(len(frame), -1),
    }
    columns = {name: np.concatenate([getattr(found, name), column])[order] for name, column in more.items()}
    return replace(
        log, cameras=(replace(camera, detections=replace(found, **columns, label_names=(*found.label_names, label))),)
    )
