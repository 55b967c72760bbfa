"""What should have been seen: which object lies in the image of which frame."""

from __future__ import annotations

import numpy as np

from objslam.association.sightings import MIN_DEPTH
from objslam.types import Camera, Floats, Ints

_CHUNK = 1 << 20


def in_view(
    positions: Floats, extents: Floats, cameras: tuple[Camera, ...], camera: Ints, map_T_camera: Floats, margin: float
) -> tuple[Ints, Ints, Floats, Floats]:
    """object (V,), frame (V,), distance (V,), pixel (V,2)."""
    found = []
    for number, model in enumerate(cameras):
        frames = np.flatnonzero(camera == number)
        step = max(1, _CHUNK // max(len(positions), 1))
        for i in range(0, len(frames), step):
            found.append(_view(positions, extents, model, frames[i : i + step], map_T_camera, margin))
    obj, frame, distance, pixel = (np.concatenate(c) for c in zip(*found, strict=True))
    order = np.lexsort((frame, obj))
    return obj[order], frame[order], distance[order], pixel[order]


def _view(positions, extents, model, frames, map_T_camera, margin):
    poses = map_T_camera[frames]
    local = np.einsum("fij,fni->fnj", poses[:, :3, :3], positions[None] - poses[:, None, :3, 3])
    distance = np.linalg.norm(local, axis=2)
    f, n = np.nonzero(local[..., 2] > np.maximum(MIN_DEPTH, distance * np.cos(_half_angle(model))))
    local, distance = local[f, n], distance[f, n]
    pixel = project(model, local)
    half = 0.5 * extents[n] * np.diag(model.matrix)[:2] / local[:, 2:] + margin
    inside = ((pixel - half >= 0) & (pixel + half <= [model.width - 1, model.height - 1])).all(axis=1)
    return n[inside], frames[f[inside]], distance[inside], pixel[inside]


def _half_angle(model: Camera) -> float:
    import cv2

    u, v = np.linspace(0.0, model.width - 1, 33), np.linspace(0.0, model.height - 1, 33)
    sides = [np.column_stack([u, np.full_like(u, at)]) for at in (0.0, model.height - 1)]
    sides += [np.column_stack([np.full_like(v, at), v]) for at in (0.0, model.width - 1)]
    edge = np.concatenate(sides)[:, None]
    undistort = cv2.fisheye.undistortPoints if model.distortion_model == "equidistant" else cv2.undistortPoints
    rays = np.asarray(undistort(edge, model.matrix, model.distortion)).reshape(-1, 2)
    return float(np.arctan(np.hypot(rays[:, 0], rays[:, 1]).max()))


def project(model: Camera, points: Floats) -> Floats:
    import cv2

    if len(points) == 0:
        return np.zeros((0, 2))
    still = np.zeros(3)
    if model.distortion_model == "equidistant":
        pixels, _ = cv2.fisheye.projectPoints(points[:, None], still, still, model.matrix, model.distortion)
    elif model.distortion.any():
        pixels, _ = cv2.projectPoints(points, still, still, model.matrix, model.distortion)
    else:
        pixels = (points @ model.matrix.T)[:, :2] / points[:, 2:]
    return np.asarray(pixels, dtype=float).reshape(-1, 2)
