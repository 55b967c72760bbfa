"""Compute exact boxes around ellipsoids from the outlines of their images."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from objslam.core.arrays import Floats
from objslam.core.camera import Camera, project
from objslam.triangulation.bodies.ellipsoid import matrices

_ANGLES = 90  # The number of points of an outline from which the search begins. More are slower.
_POINTS = 720  # The number of points of an outline that is clipped. More are more exact and slower.
_STEPS = 8  # The number of steps of the search for an extreme pixel. More are more exact and slower.
_NEAREST = 0.05  # The least depth, m, of an outline. A larger value drops closer bodies.


def from_axes(centre: Floats, half: Floats, yaw: Floats) -> Floats:
    """Return ellipsoids (N, 7) from centres (N, 3), half axes (N, 3) along x, y, z before the turn, m, and yaws (N,)."""
    log = np.log(half)
    aspect = (log[:, 0] - log[:, 1]) / 2
    flat = [(log[:, 0] + log[:, 1]) / 2, aspect * np.cos(2 * yaw), aspect * np.sin(2 * yaw)]
    return np.column_stack([centre, *flat, log[:, 2]])


def looking_at(place: Floats, target: Floats) -> Floats:
    """Return map_T_camera (4, 4) of a level camera at a place (3,) that looks at a target (3,), m."""
    z = target - place
    z = z / np.linalg.norm(z)
    x = np.cross(z, [0, 0, 1.0])
    x /= np.linalg.norm(x)
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = np.column_stack([x, np.cross(z, x), z]), place
    return pose


def outline_box(camera: Camera, body: Floats, pose: Floats) -> Floats | None:
    """Return the box (4,), px, around the image of an ellipsoid (7,), None if a part of it is behind the camera.

    The tangent rays of the camera touch the ellipsoid along an ellipse, whose extreme pixels are searched. So the box is
    exact for distorted lenses, and independent of `triangulation.bodies`. body: centre and half axes, m, and yaw, rad. pose:
    (4, 4) map_T_camera.
    """
    pixels = _outline(camera, body, pose)
    if pixels is None:
        return None
    angles = np.linspace(0, 2 * np.pi, _ANGLES, endpoint=False)
    rough = pixels(angles)
    best = angles[[rough[:, 0].argmin(), rough[:, 1].argmin(), rough[:, 0].argmax(), rough[:, 1].argmax()]]
    side, step = np.arange(4), np.full(4, 2 * np.pi / _ANGLES)  # The sides are left, top, right, and bottom.
    for _ in range(_STEPS):  # the vertex of a parabola through three points
        three = pixels((best + step * np.array([[-1], [0], [1]])).ravel()).reshape(3, 4, 2)
        before, at, after = three[:, side, side % 2]
        bend = before - 2 * at + after
        move = 0.5 * step * (before - after) / np.where(bend == 0, 1.0, bend)
        best = best + np.where(bend == 0, 0.0, np.clip(move, -step, step))
        step = np.maximum(step / 4, 1e-4)
    return np.asarray(pixels(best)[side, side % 2])


def visible_box(camera: Camera, body: Floats, pose: Floats) -> Floats | None:
    """Return the box (4,), px, around the part of an ellipsoid (7,) that is in the image of a pinhole camera.

    The outline is clipped by the four edges of the image (Sutherland and Hodgman 1974). None if no part of it is in the
    image, or if a part of it is behind the camera. The arguments are those of `outline_box`.
    """
    pixels = _outline(camera, body, pose)
    if pixels is None:
        return None
    shown = pixels(np.linspace(0, 2 * np.pi, _POINTS, endpoint=False))
    for axis, sign, limit in ((0, 1, 0), (1, 1, 0), (0, -1, camera.size[0] - 1), (1, -1, camera.size[1] - 1)):
        off = sign * (shown[:, axis] - limit)
        other, beyond = np.roll(shown, -1, axis=0), np.roll(off, -1)
        crosses = (off >= 0) != (beyond >= 0)
        share = (off[crosses] / (off - beyond)[crosses])[:, None]
        crossing = shown[crosses] + share * (other - shown)[crosses]
        # The order of points matters for the next edge, so each crossing follows the point before it.
        place = np.concatenate([np.flatnonzero(off >= 0), np.flatnonzero(crosses) + 0.5])
        shown = np.concatenate([shown[off >= 0], crossing])[np.argsort(place)]
        if not len(shown):
            return None
    return np.concatenate([shown.min(axis=0), shown.max(axis=0)])


def _outline(camera: Camera, body: Floats, pose: Floats) -> Callable[[Floats], Floats] | None:
    """Return a function from angles (n,) around an ellipsoid (7,) to the pixels (n, 2) of its outline.

    None if a part of it is behind the camera.
    """
    root = np.linalg.cholesky(matrices(body[None])[0])
    seen = np.linalg.solve(root, pose[:3, 3] - body[:3])
    distance = np.linalg.norm(seen)
    if distance <= 1:
        return None
    seen /= distance
    a = np.cross(seen, [0.3, 0.5, 0.8])
    a /= np.linalg.norm(a)
    b = np.cross(seen, a)

    def points(angle: Floats) -> Floats:
        ring = np.sqrt(1 - distance**-2) * (np.cos(angle)[:, None] * a + np.sin(angle)[:, None] * b)
        on_body = body[:3] + (seen / distance + ring) @ root.T
        return np.asarray((on_body - pose[:3, 3]) @ pose[:3, :3])

    if points(np.linspace(0, 2 * np.pi, _ANGLES, endpoint=False))[:, 2].min() < _NEAREST:
        return None
    return lambda angle: project(camera, points(angle))
