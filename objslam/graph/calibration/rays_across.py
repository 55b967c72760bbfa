"""Compute how the residuals of rays change if base moves between two images of a multiframe."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Self

import numpy as np

from objslam.core.arrays import Floats, Ints
from objslam.core.geometry import adjoint, inverse, lengths
from objslam.core.types import Keyframes, Rays
from objslam.graph.calibration.linearised_graph import Linearised
from objslam.graph.least_squares.joint_rows import from_origins

_STEP = 1e-6
"""The step (rad and m) of the twist over which residuals are differentiated. A longer step adds more of the curvature, and a
shorter step adds rounding errors."""


@dataclass(frozen=True)
class RaysAcross:
    """The n rays of images that are not the first of their multiframe, and how a clock moves them.

    The first image gives the pose of the multiframe. If the clock of another image is later, base has moved on in between.
    If the clock of the first image is later, base has moved back.

    pose: (n,) the multiframe of each ray. sign: for each clock, by the index of its parameter, (n,) 1 if it is the clock of
    the ray's image, -1 if it is the clock of the first image, and 0 for neither. rows: (n, 3) the rows of each ray in the
    linear system, two of its bearing and one of its range, -1 without a range. to_rows: (n, 3, 6) from velocities of base,
    with the rotation first, to the rows.
    """

    pose: Ints
    sign: Mapping[int, Ints]
    rows: Ints
    to_rows: Floats

    @classmethod
    def of(cls, of: Linearised, images: Keyframes, rays: Rays, clocks: Mapping[int, int]) -> Self:
        """Return the rays of a graph.

        images: the corrected images. rays: the corrected rays in the graph, with the directions that the solution expects.
        clocks: the camera of each clock, by the index of its parameter.
        """
        joined, graph, image = of.measured.multiframes, of.graph, rays.keyframe
        first = joined.first[joined.number[image]]
        which = np.flatnonzero(first != image)
        pose, camera, of_first = joined.number[image[which]], images.camera[image[which]], images.camera[first[which]]
        sign = {k: (camera == one).astype(np.int64) - (of_first == one) for k, one in clocks.items()}
        if not len(which):
            return cls(pose, sign, np.zeros((0, 3), dtype=np.int64), np.zeros((0, 3, 6)))
        ranged = np.full(len(image), -1)
        ranged[graph.ranged] = np.arange(len(graph.ranged))
        ranged = ranged[which]
        has = ranged >= 0
        to_landmark = from_origins(graph.rays, graph.seen(of.map_T_camera, of.positions[of.landmarks]))
        axes = graph.bearing_axes(to_landmark)
        bearing_root, _ = graph.bearing_roots(graph.bearing_residuals(graph.rays.direction, to_landmark, axes))
        range_root, _ = graph.range_roots(lengths(to_landmark[graph.ranged]))
        rays = joined.rays(images, rays)
        direction, to_landmark, axes, bearing_root = (
            one[which] for one in (rays.direction, to_landmark, axes, bearing_root)
        )
        origin = np.zeros_like(direction) if rays.offset is None else rays.offset[which]

        def residuals(twist: Floats) -> Floats:
            turned = direction + np.cross(twist[:3], direction)
            to = to_landmark - np.cross(twist[:3], origin) - twist[3:]
            result = np.zeros((len(which), 3))
            result[:, :2] = bearing_root * graph.bearing_residuals(turned, to, axes)
            result[has, 2] = range_root[ranged[has]] * lengths(to[has])
            return result

        steps = _STEP * np.eye(6)
        by_camera = np.stack([(residuals(step) - residuals(-step)) / (2 * _STEP) for step in steps], axis=2)
        to_camera = adjoint(inverse(images.base_T_camera[first[which]]))
        rows = np.column_stack([2 * which, 2 * which + 1, np.where(has, graph.first_range + ranged, -1)])
        return cls(pose, sign, rows, by_camera @ to_camera)

    def put(self, columns: Floats, clock: int, velocity: Floats) -> None:
        """Write the derivatives by a clock, for n sets of velocities (K, 6, n) of base, into the columns (M, n)."""
        mine = np.flatnonzero(self.sign[clock])
        values = self.sign[clock][mine, None, None] * (self.to_rows[mine] @ velocity[self.pose[mine]])
        there = self.rows[mine] >= 0
        columns[self.rows[mine][there]] = values[there]

    def pull(self, residual: Floats, clock: int, count: int) -> Floats:
        """Return the factors (count, 6) of velocities in the product of residuals (M,) with the columns that `put` writes.

        count: the number of poses.
        """
        pulls = np.zeros((count, 6))
        mine = np.flatnonzero(self.sign[clock])
        rows = self.rows[mine]
        here = np.where(rows >= 0, residual[rows], 0.0) * self.sign[clock][mine, None]
        np.add.at(pulls, self.pose[mine], np.einsum("rk,rki->ri", here, self.to_rows[mine]))
        return pulls
