"""Bodies of the landmarks of a running session. A separate process fits them, because a fit takes longer than a frame."""

from __future__ import annotations

import time
from dataclasses import dataclass, replace

import numpy as np

from objslam.config import Settings
from objslam.core.arrays import Floats, Ints
from objslam.core.bodies.body import PlacedBody
from objslam.core.camera import Camera
from objslam.core.estimate import Estimate
from objslam.core.geometry import inverse
from objslam.core.object_map import MapObject
from objslam.core.types import Association
from objslam.live.calibration.collected import offline_rays
from objslam.live.mapper.state import MapState
from objslam.live.worker import Worker
from objslam.mapping.bodies.fitting import FEWEST, with_bodies
from objslam.mapping.solution import Solution

_BOXES = 40
"""The most boxes of an object in a fit. They are spread evenly over its boxes. More make bodies surer and fits slower."""
_OBJECTS = 100
"""The most objects in one fit. A larger number delays the bodies of all of them, and takes longer to collect."""
_GROWTH = 1.25
"""A body is fitted again when the number of the object's rays has grown by this factor. With a larger factor, bodies are
older."""
_REST = 1.0
"""The time between two fits, s. A longer time leaves more of the processor to others, but makes bodies older."""


@dataclass(frozen=True)
class BodyRequest:
    """The input of a fit: some landmarks with some of their boxes, at the session's estimate."""

    solution: Solution
    cameras: tuple[Camera, ...]
    settings: Settings

    def solve(self) -> tuple[PlacedBody | None, ...]:
        """Return the body of each landmark, None for a point."""
        found = with_bodies(self.solution, self.cameras, self.settings).bodies
        return (None,) * self.solution.association.count if found is None else found


@dataclass(frozen=True)
class _Fitted:
    """A landmark in a fit: the number of its rays, its position (3,), m, and its body, None before the fit has ended."""

    rays: int
    position: Floats
    body: PlacedBody | None = None


class BodyEstimator:
    """Keeps the last body of each landmark, and starts a new fit when bodies are due and the process has rested.

    Bodies only describe the map of a snapshot. The map itself does not depend on them.
    """

    def __init__(self) -> None:
        self._fitted: dict[int, _Fitted] = {}
        self._asked: dict[int, _Fitted] = {}
        self._worker: Worker[tuple[PlacedBody | None, ...]] = Worker()
        self._rested = -np.inf  # When the next fit may begin, s.

    def update(self, m: MapState, covariances: dict[int, Floats]) -> None:
        """Take the bodies of a fit that has ended, or begin a fit.

        covariances: the covariance (3, 3), m^2, of each landmark that may have a body, by its id.
        """
        now = time.monotonic()
        if self._worker.busy:
            if self._worker.done:
                self._take(self._worker.result())
                self._rested = now + _REST
            return
        if now < self._rested or not m.settings.bodies.use or not any(camera.sees_size for camera in m.cameras):
            return
        due = self._due(m, covariances)
        if len(due):
            self._worker.ask(self._request(m, due, covariances))

    def described(self, o: MapObject) -> MapObject:
        """Return a resolved object with its body.

        If the landmark has moved since the fit, the body has moved with it. The covariance is that of the fit.
        """
        fitted = self._fitted.get(o.id)
        if fitted is None or fitted.body is None or o.status != "ok":
            return o
        placed = fitted.body
        if placed.centre is None:
            return replace(o, body=placed.body)
        centre = o.position + placed.centre - fitted.position
        return replace(o, body=placed.body, position=centre, covariance=placed.covariance[:3, :3], ray_point=o.position)

    def close(self) -> None:
        """End the process."""
        self._worker.close()

    def _take(self, bodies: tuple[PlacedBody | None, ...] | None) -> None:
        if bodies is None:  # The process failed. The same boxes are not tried again.
            bodies = (None,) * len(self._asked)
        for (j, fitted), body in zip(self._asked.items(), bodies, strict=True):
            self._fitted[j] = replace(fitted, body=body)

    def _due(self, m: MapState, covariances: dict[int, Floats]) -> Ints:
        """Return the rows of the landmarks to fit, in the order of their ids. If too many are due, those that have grown
        most are fitted."""
        landmarks = m.landmarks
        self._fitted = {j: self._fitted[j] for j in landmarks.id.tolist() if j in self._fitted}
        before = np.array([self._fitted[j].rays if j in self._fitted else 0 for j in landmarks.id.tolist()])
        ready = np.isin(landmarks.id, list(covariances)) & (landmarks.seen >= np.maximum(FEWEST, _GROWTH * before))
        rows = np.flatnonzero(ready)
        growth = landmarks.seen[rows] / np.maximum(before[rows], 1)
        chosen = rows[np.argsort(-growth, kind="stable")[:_OBJECTS]]
        return np.asarray(chosen[np.argsort(landmarks.id[chosen])])

    def _request(self, m: MapState, rows: Ints, covariances: dict[int, Floats]) -> BodyRequest:
        ids = m.landmarks.id[rows]
        boxes = _some_boxes(m, ids)
        frames, index = np.unique(np.searchsorted(m.keyframes.id, m.rays.keyframe[boxes]), return_inverse=True)
        keyframes = m.keyframe_arrays(frames)
        positions = m.graph.points(ids)
        self._asked = {
            j: _Fitted(int(seen), point)
            for j, seen, point in zip(ids.tolist(), m.landmarks.seen[rows].tolist(), positions, strict=True)
        }
        estimate = Estimate(
            map_T_base=m.graph.poses(m.keyframes.id[frames]) @ inverse(keyframes.base_T_camera),
            positions=positions,
            covariance=np.array([covariances[j] for j in ids.tolist()]),
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
    """Return the rows of at most `_BOXES` rays of each landmark, in the order of the rays. ids: (n,) in order."""
    mine = np.flatnonzero(m.rays.used & np.isin(m.rays.owner, ids))
    mine = mine[np.argsort(m.rays.owner[mine], kind="stable")]
    of_each = np.split(mine, np.searchsorted(m.rays.owner[mine], ids[1:]))
    chosen = [rows[np.linspace(0, len(rows) - 1, min(len(rows), _BOXES)).astype(np.int64)] for rows in of_each]
    return np.sort(np.concatenate(chosen))
