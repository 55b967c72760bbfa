"""Boxes of bodies with the poses of their cameras, and the planes through their edges."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Self

import numpy as np

from objslam.association.observations import MIN_DEPTH
from objslam.config import Settings
from objslam.core.arrays import Bools, Floats, Ints
from objslam.core.camera import Camera, undistort
from objslam.core.types import Keyframes, Rays
from objslam.graph.fixed_pose_triangulation import pose_noise
from objslam.triangulation.bodies.edges import BoxEdges, contacts, tangent_planes


@dataclass(frozen=True)
class BoxViews:
    """B boxes of n bodies.

    rays: the rays of the boxes, whose ranges end on surfaces. map_T_camera: (K, 4, 4) the poses of the cameras at the
    keyframes. body: (B,) the body of each box. points: (n, 3) m, the points of the objects. half: (n, 2) m, the apparent
    half axes of the objects, across and upwards. bound: (B, 4) as in `BoxEdges`.
    """

    keyframes: Keyframes
    rays: Rays
    cameras: tuple[Camera, ...]
    settings: Settings
    map_T_camera: Floats
    body: Ints
    points: Floats
    half: Floats
    bound: Bools

    @property
    def side(self) -> Floats:
        """(B,) px, half the geometric mean of the width and height of the image with each box."""
        half = np.array([np.sqrt(c.size.prod()) / 2 for c in self.cameras])
        return np.asarray(half[self.camera])

    @property
    def bent(self) -> bool:
        """Whether any used camera distorts its image."""
        return any(self.cameras[i].fisheye or self.cameras[i].distortion.any() for i in np.unique(self.camera))

    @property
    def camera(self) -> Ints:
        """(B,) the number of the camera of each box."""
        return self.keyframes.camera[self.rays.keyframe]

    @property
    def poses(self) -> Floats:
        """(B, 4, 4) map_T_camera of the image with each box."""
        return self.map_T_camera[self.rays.keyframe]

    def take(self, boxes: Bools | Ints) -> Self:
        """Select boxes by a mask or increasing indices."""
        return replace(self, rays=self.rays.take(boxes), body=self.body[boxes], bound=self.bound[boxes])

    def contacts(self, touched: Floats) -> Floats:
        """Return the positions (B, 4), px along each edge, where the edges of boxes touch the images of bodies.

        touched: (B, 4, P, 3) m, the points of the bodies that each edge may touch.
        """
        found, poses = np.zeros((len(self.body), 4)), self.poses
        for i in np.unique(self.camera):
            mine = np.flatnonzero(self.camera == i)
            found[mine] = contacts(self.cameras[i], self.rays.box[mine], poses[mine], touched[mine])
        return found

    def edges(self, touched: Floats | None = None) -> BoxEdges:
        """Return the planes through the edges of the boxes.

        touched: (B, 4, P, 3) m, the points where the bodies may touch the planes. Without them, each plane is taken at the
        middle of its edge.
        """
        return self._at_middles if touched is None else self._edges(touched)

    @cached_property
    def _at_middles(self) -> BoxEdges:
        return self._edges(None)

    def _edges(self, touched: Floats | None) -> BoxEdges:
        rays, settings, poses, camera = self.rays, self.settings, self.poses, self.camera
        count = len(self.body)
        normal, turn, bound = np.zeros((count, 4, 3)), np.ones((count, 4)), self.bound.copy()
        direction = np.zeros((count, 3))  # The direction of a ray may already point to the centre of a body.
        good = np.zeros(count, dtype=bool)
        contact = None if touched is None else self.contacts(touched)
        for i in np.unique(camera):
            mine = np.flatnonzero(camera == i)
            box, at = rays.box[mine], None if contact is None else contact[mine]
            normal[mine], turn[mine], good[mine] = tangent_planes(self.cameras[i], box, poses[mine], at)
            direction[mine], _ = undistort(self.cameras[i], (box[:, :2] + box[:, 2:]) / 2)
        turn[~good] = 1.0
        bound[~good] = True  # A bound of a plane without a normal never counts.
        own = self.points[self.body] - poses[:, :3, 3]
        distance = np.maximum(np.linalg.norm(own, axis=1), MIN_DEPTH)
        yaw, place = np.zeros(count), 0.0
        if settings.mode != "joint":
            angle, place = pose_noise(rays, self.keyframes, settings)
            yaw = np.sqrt(np.maximum(angle**2 - rays.sigma**2, 0.0))
        size = np.sqrt(np.maximum(rays.box[:, 2:] - rays.box[:, :2], 0.0).prod(axis=1))
        return BoxEdges(
            body=self.body,
            origin=poses[:, :3, 3],
            normal=normal,
            turn=turn,
            sigma=np.full(count, np.sqrt(2) * settings.rays.pixel_sigma),
            shift=np.hypot(yaw, place / distance) / turn.mean(axis=1),
            bound=bound,
            size=size,
            direction=np.einsum("bij,bj->bi", poses[:, :3, :3], direction),
            range=rays.range,
            range_sigma=np.hypot(rays.range_sigma, place),
            # A range may end on any part of the body, or behind it if the body has holes.
            range_bias=np.where(np.isfinite(rays.range), np.hypot(rays.range_bias, self.half[self.body, 0]), 0.0),
        )
