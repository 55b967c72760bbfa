"""Bodies of the landmarks of a running session. A separate process fits them, because a fit takes longer than a frame."""

from __future__ import annotations

import time
from dataclasses import dataclass, replace

import numpy as np

from objslam.core.arrays import Floats, Ints
from objslam.core.bodies.body import PlacedBody
from objslam.core.object_map import MapObject
from objslam.live.bodies.request import body_request, most_grown
from objslam.live.mapper.state import MapState
from objslam.live.worker import Worker
from objslam.mapping.bodies.fitting import FEWEST

_GROWTH = 1.25
"""The factor by which the number of an object's rays grows before its body is fitted again. With a larger factor, bodies are
older."""
_REST = 1.0
"""The time from the end of a fit to the start of the next fit, s. A longer time leaves more of the processor to others, but
makes bodies older."""


@dataclass(frozen=True)
class _Fitted:
    """A landmark in a fit: the number of its rays, its position (3,), m, and its body, or None before the fit has ended.

    turned: whether the landmark's bearings pointed to the centre of a body.
    """

    rays: int
    position: Floats
    turned: bool
    body: PlacedBody | None = None


class BodyEstimator:
    """Keeps the last body of each landmark, and starts a new fit when bodies are due and the process has rested.

    These bodies only describe the map of a snapshot. The map itself does not depend on them, but on the bodies of
    `BodyCentring`.
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
            ids = m.landmarks.id[due]
            positions, turned = m.graph.points(ids), m.landmarks.shape[due] > 0
            columns = zip(ids.tolist(), m.landmarks.seen[due].tolist(), positions, turned.tolist(), strict=True)
            self._asked = {j: _Fitted(int(seen), *rest) for j, seen, *rest in columns}
            self._worker.ask(body_request(m, due, np.array([covariances[j] for j in ids.tolist()])))

    def described(self, o: MapObject, turned: bool) -> MapObject:
        """Return a resolved object with its body. turned: whether its bearings point to the centre of a body.

        If the landmark has moved since the fit, the body moves with it. If `turned` has changed since the fit, the body has
        its centre at the landmark. The covariance comes from the fit.
        """
        fitted = self._fitted.get(o.id)
        if fitted is None or fitted.body is None or o.status != "ok":
            return o
        placed = fitted.body
        if placed.centre is None:
            return replace(o, body=placed.body)
        beside = placed.centre - fitted.position if turned == fitted.turned else np.zeros(3)
        centre = o.position + beside
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
        """Return the rows of the landmarks to fit, in the order of their ids. If too many are due, the ones whose rays have
        grown most are fitted."""
        landmarks = m.landmarks
        self._fitted = {j: self._fitted[j] for j in landmarks.id.tolist() if j in self._fitted}
        before = np.array([self._fitted[j].rays if j in self._fitted else 0 for j in landmarks.id.tolist()])
        ready = np.isin(landmarks.id, list(covariances)) & (landmarks.seen >= np.maximum(FEWEST, _GROWTH * before))
        rows = np.flatnonzero(ready)
        return most_grown(m, rows, before[rows])
