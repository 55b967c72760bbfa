"""The input of a fit of bodies: some landmarks of a running session with some of their boxes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from objslam.config import Settings
from objslam.core.arrays import Floats, Ints
from objslam.core.bodies.body import PlacedBody
from objslam.core.camera import Camera
from objslam.core.estimate import Estimate
from objslam.core.geometry import inverse
from objslam.core.types import Association
from objslam.live.calibration.collected import offline_rays
from objslam.live.mapper.state import MapState
from objslam.mapping.bodies.fitting import with_bodies
from objslam.mapping.solution import Solution

_BOXES = 40
"""The most boxes of an object in a fit. They are spread evenly over all its boxes. With a larger number, bodies are more
certain, and fits take longer."""
_OBJECTS = 100
"""The most objects in one fit. With a larger number, all bodies come later, and the boxes take longer to collect."""


@dataclass(frozen=True)
class BodyRequest:
    """The input of a fit: some landmarks with some of their boxes, at the session's estimate."""

    solution: Solution
    cameras: tuple[Camera, ...]
    settings: Settings

    def fitted(self) -> Solution:
        """Return the solution with bodies."""
        return with_bodies(self.solution, self.cameras, self.settings)

    def solve(self) -> tuple[PlacedBody | None, ...]:
        """Return the body of each landmark, or None for a landmark that stays a point."""
        found = self.fitted().bodies
        return (None,) * self.solution.association.count if found is None else found


def most_grown(m: MapState, rows: Ints, before: Ints) -> Ints:
    """Return the rows of the landmarks to fit, in the order of their ids. If too many are due, return the ones whose rays
    have grown most.

    rows: (n,) the rows of the landmarks that are due. before: (n,) the number of rays of each landmark in its last fit, 0 if
    it had none.
    """
    growth = m.landmarks.seen[rows] / np.maximum(before, 1)
    return np.sort(rows[np.argsort(-growth, kind="stable")[:_OBJECTS]])


def body_request(m: MapState, rows: Ints, covariances: Floats) -> BodyRequest:
    """Return a request for the landmarks in rows (n,), in the order of their ids. covariances: (n, 3, 3) of the landmarks,
    m^2."""
    ids = m.landmarks.id[rows]
    boxes = _some_boxes(m, ids)
    frames, index = np.unique(np.searchsorted(m.keyframes.id, m.rays.keyframe[boxes]), return_inverse=True)
    keyframes = m.keyframe_arrays(frames)
    estimate = Estimate(
        map_T_base=m.graph.poses(m.keyframes.id[frames]) @ inverse(keyframes.base_T_camera),
        positions=m.graph.points(ids),
        covariance=covariances,
        seen_sigma=np.full(len(ids), np.nan),
        solved=np.ones(len(ids), dtype=bool),
        weight=np.ones(len(boxes)),
        cost_before=0.0,
        cost_after=0.0,
        iterations=0,
    )
    association = Association(np.searchsorted(ids, m.rays.owner[boxes]), m.landmarks.label[rows])
    solution = Solution(keyframes, offline_rays(m, boxes, index), association, estimate, ())
    return BodyRequest(solution, tuple(m.cameras), m.settings)


def _some_boxes(m: MapState, ids: Ints) -> Ints:
    """Return the rows of at most `_BOXES` rays of each landmark, in the order of the rays. ids: (n,) of the landmarks, in
    ascending order."""
    mine = np.flatnonzero(m.rays.used & np.isin(m.rays.owner, ids))
    mine = mine[np.argsort(m.rays.owner[mine], kind="stable")]
    of_each = np.split(mine, np.searchsorted(m.rays.owner[mine], ids[1:]))
    chosen = [rows[np.linspace(0, len(rows) - 1, min(len(rows), _BOXES)).astype(np.int64)] for rows in of_each]
    return np.sort(np.concatenate(chosen))
