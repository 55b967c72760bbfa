"""Exact boxes around the images of ellipsoids, by their outlines, for tests and benchmarks of bodies."""

from __future__ import annotations

import numpy as np

from objslam.core.arrays import Floats
from objslam.core.camera import Camera, project
from objslam.triangulation.bodies.ellipsoid import matrices

_ANGLES = 90  # The number of points of an outline from which the search begins. More are slower.
_STEPS = 8  # The number of steps of the search for an extreme pixel. More are more exact and slower.
_NEAREST = 0.05  # The least depth, m, of an outline. A larger value drops closer bodies.


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
    root = np.linalg.cholesky(matrices(body[None])[0])
    seen = np.linalg.solve(root, pose[:3, 3] - body[:3])
    distance = np.linalg.norm(seen)
    if distance <= 1:
        return None
    seen /= distance
    a = np.cross(seen, [0.3, 0.5, 0.8])
    a /= np.linalg.norm(a)
    b = np.cross(seen, a)

    def pixels(angle: Floats) -> tuple[Floats, float]:
        ring = np.sqrt(1 - distance**-2) * (np.cos(angle)[:, None] * a + np.sin(angle)[:, None] * b)
        points = body[:3] + (seen / distance + ring) @ root.T
        local = (points - pose[:3, 3]) @ pose[:3, :3]
        return project(camera, local), float(local[:, 2].min())

    angles = np.linspace(0, 2 * np.pi, _ANGLES, endpoint=False)
    rough, nearest = pixels(angles)
    if nearest < _NEAREST:
        return None
    sides = []
    for axis, pick in ((0, np.argmin), (1, np.argmin), (0, np.argmax), (1, np.argmax)):
        best, step = angles[pick(rough[:, axis])], 2 * np.pi / _ANGLES
        for _ in range(_STEPS):  # the vertex of a parabola through three points
            before, at, after = pixels(best + step * np.array([-1, 0, 1]))[0][:, axis]
            bend = before - 2 * at + after
            best += np.clip(0.5 * step * (before - after) / bend, -step, step) if bend else 0.0
            step = max(step / 4, 1e-4)
        sides.append(pixels(np.array([best]))[0][0, axis])
    return np.array(sides)
