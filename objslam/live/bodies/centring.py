"""Turns the bearings of a running session to the centres of bodies, in rounds."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from objslam.config import Settings
from objslam.core.arrays import Ints
from objslam.core.bodies.body import SHAPES
from objslam.live.bodies.request import BodyRequest, body_request, most_grown
from objslam.live.counters import Counters
from objslam.live.rounds import Rounds
from objslam.mapping.bodies.centre_bearings import worth_turning
from objslam.mapping.bodies.fitting import FEWEST
from objslam.sources.journal.corrections import BodiesMessage

if TYPE_CHECKING:
    from objslam.live.mapper.mapper import Mapper
    from objslam.live.mapper.state import MapState

_FIRST = 30
"""The number of keyframes at the first round. Fewer keyframes have too few boxes of any object."""
_GROWTH = 1.3
"""The factor by which the number of keyframes grows between the starts of two rounds. With a larger factor, bearings are
turned later. With a smaller factor, the graph is solved more often."""
_DELAY = 0.1
"""The share by which the number of keyframes grows between the start of a round and the correction of the map. A larger
share suits slower machines, but corrects later."""

_CHANGED = 0.05
"""The change of a bearing, in its standard deviations, above which the bearing in the graph is turned again. A larger value
changes the graph less often, but bearings point to the centres of older bodies for longer."""


@dataclass(frozen=True)
class CentringRequest:
    """A request for the bodies of some landmarks. boxes: the landmarks with their boxes. ids: (n,) the ids of the
    landmarks."""

    boxes: BodyRequest
    ids: Ints

    def solve(self) -> BodiesMessage:
        """Return the bodies of the landmarks. The number of the keyframe is 0, and the caller must set it. A landmark gets
        shape 0, which means no body, if its body would hardly turn its bearings."""
        found = self.boxes.fitted()
        n = len(self.ids)
        shape, half, yaw, covariance = np.zeros(n, dtype=np.int64), np.zeros((n, 3)), np.zeros(n), np.zeros((n, 4, 4))
        if found.bodies is not None and found.to_centre is not None:
            worth = worth_turning(found.to_centre, found.rays.sigma, found.association)
            to_half = np.diag([0.5, 0.5, 0.5, 1.0])
            for i, placed in enumerate(found.bodies):
                if placed is not None and worth[i]:
                    shape[i], half[i] = SHAPES.index(placed.body.shape), placed.body.size / 2
                    yaw[i], covariance[i] = placed.body.yaw, to_half @ placed.covariance[3:, 3:] @ to_half
        return BodiesMessage(0, self.ids, shape, half, yaw, covariance)


class BodyCentring(Rounds[BodiesMessage, BodiesMessage]):
    """Fits bodies in rounds, and turns the bearings of their landmarks to their centres."""

    growth, delay, quick, told = _GROWTH, _DELAY, True, BodiesMessage

    def __init__(
        self,
        settings: Settings,
        counters: Counters,
        mapper: Mapper,
        record: Callable[[BodiesMessage], bool],
        patient: bool,
    ) -> None:
        super().__init__(mapper, record, _FIRST if settings.bodies.use else 0, patient)
        self._counters = counters
        self._rays: dict[int, int] = {}  # How many rays each landmark had in its last round, by id.

    def _request(self) -> CentringRequest | None:
        """Return the landmarks that may have a body. If too many are due, return the ones whose rays have grown most."""
        m = self._mapper.state
        landmarks = m.landmarks
        if not any(camera.sees_size for camera in m.cameras):
            return None
        m.graph.refresh()
        due = np.flatnonzero(landmarks.seen >= FEWEST)
        before = np.array([self._rays.get(j, 0) for j in landmarks.id[due].tolist()], dtype=np.int64)
        rows = most_grown(m, due, before)
        rows = rows[np.isin(landmarks.id[rows], m.rays.owner[m.rays.used])]
        ids = landmarks.id[rows]
        if not len(ids):
            return None
        self._rays.update(zip(ids.tolist(), landmarks.seen[rows].tolist(), strict=True))
        return CentringRequest(body_request(m, rows, np.zeros((len(ids), 3, 3))), ids)

    def _correction(self, number: int, answer: BodiesMessage | None) -> BodiesMessage | None:
        m = self._mapper.state
        if answer is None:
            self._counters.accept("fits of bodies given up")
            return None
        there = np.isin(answer.ids, m.landmarks.id)
        stays = m.landmarks.shape[m.rows_of(answer.ids[there])] == 0
        if not (answer.shape > 0)[there].any() and stays.all():
            return None
        columns = (getattr(answer, name)[there] for name in ("ids", "shape", "half", "yaw", "covariance"))
        return BodiesMessage(number, *columns)

    def _take_up(self, correction: BodiesMessage) -> None:
        m = self._mapper.state
        if turn_to_centres(m, correction):
            m.rebuild_in_slices()  # Bearings turn by small angles, so the next frame need not wait for a solve.
            self._counters.accept("turns to the centres of bodies")


def turn_to_centres(m: MapState, found: BodiesMessage) -> bool:
    """Turn the bearings of landmarks to the centres of the bodies in `found`. A landmark of shape 0 has no body.

    Return whether bearings in the graph have changed. A bearing that would hardly change (`_CHANGED`) is not turned.
    Landmarks that are not in the map any more are left out.
    """
    m.graph.refresh()
    m.read_positions()
    landmarks, rays = m.landmarks, m.rays
    there = np.isin(found.ids, landmarks.id)
    rows = m.rows_of(found.ids[there])
    before = landmarks.shape[rows] > 0
    landmarks.shape[rows], landmarks.half[rows], landmarks.yaw[rows] = (
        found.shape[there],
        found.half[there],
        found.yaw[there],
    )
    landmarks.shape_covariance[rows] = found.covariance[there]
    rows = rows[before | (landmarks.shape[rows] > 0)]
    at = np.flatnonzero(rays.used & np.isin(rays.owner, landmarks.id[rows]))
    added, sigma = m.to_centres(at)
    change = np.hypot(np.linalg.norm(added - rays.to_centre[at], axis=1), sigma - rays.centre_sigma[at])
    new = change > _CHANGED * rays.sigma[at]
    at = at[new]
    if not len(at):
        return False
    rays.to_centre[at], rays.centre_sigma[at] = added[new], sigma[new]
    m.graph.drop_rays(rays.number[at])
    m.graph.add_rays(m.bearings(at))
    return True
