"""Judges in rounds which labels of a running session are names.

The label of a person who walks is taken for a name at first. So is the label of two cups that no frame shows together. The
rays of such labels bend the path of a session, and then the rays of true names disagree as well. Only a solve of the whole
drive shows which labels are names. This solve leaves out labels whose rays scatter. The labels whose rays agree stay names.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from objslam.config import Settings
from objslam.core.arrays import Bools, Ints
from objslam.core.camera import Camera
from objslam.core.diagnostics import Ledger
from objslam.live.calibration.collected import Collected, collect
from objslam.live.counters import Counters
from objslam.live.mapper.landmark_update import drop_landmarks
from objslam.live.mapper.mapper import Mapper
from objslam.live.mapper.state import MapState
from objslam.live.mapper.track_promotion import add_landmark, fit_if_observable
from objslam.live.names.contradicted import contradicted
from objslam.live.rounds import Rounds
from objslam.mapping.joint.labels import MANY
from objslam.sources.journal.corrections import NamesMessage

_GROWTH = 1.3
"""The factor by which the number of keyframes grows between the starts of two rounds. A round only begins if a name is
contradicted. With a larger factor, labels are judged more rarely, which takes less time."""
_DELAY = 0.1
"""The share by which the number of keyframes grows between the start of a round and the effect of its judgement. A larger
share suits slower machines, but a thing that moves stays in the map for longer."""
_AGREE = 0.5
"""The least share of a name's rays that must meet in one point before the name gets a landmark again. A larger share gives
fewer landmarks."""
_SLACK = 0.2
"""The assumed standard deviation (m) of the camera poses when a name gets a landmark again, because wrong names have bent
the path. With a larger value, more rays count for the first position of the landmark."""


@dataclass(frozen=True)
class NamesRequest:
    """The drive of a session so far."""

    found: Collected
    cameras: tuple[Camera, ...]
    settings: Settings

    def solve(self) -> NamesMessage | None:
        """Judge the labels by the offline solve of names. The keyframe of the message is 0, and the caller must set it.
        Return None if the labels do not determine the path. Raises SolveError if the solve fails."""
        from objslam.mapping.joint.joint_alternation import JointState
        from objslam.mapping.joint_solve import solve_names
        from objslam.mapping.solution import seen_something

        f = self.found
        seen = seen_something(f.keyframes, f.rays)
        begin = JointState(
            f.keyframes, f.rays, *seen, self.cameras, self.settings, Ledger(), lambda *_: None, None, f.errors
        )
        state = solve_names(begin)
        if state is None or state.association is None:
            return None
        labels = len(f.rays.label_names)
        objects = np.bincount(state.association.label, minlength=labels)
        many = np.bincount(f.rays.label, minlength=labels) >= MANY
        kinds = objects == 1, objects > 1, (objects == 0) & many
        return NamesMessage(0, *(np.flatnonzero(kind) for kind in kinds))


class NameJudge(Rounds[NamesMessage | None, NamesMessage]):
    """Judges the labels in rounds, and corrects the map."""

    growth, delay, quick, told = _GROWTH, _DELAY, False, NamesMessage

    def __init__(
        self,
        settings: Settings,
        counters: Counters,
        mapper: Mapper,
        record: Callable[[NamesMessage], bool],
        name: str,
        patient: bool,
    ) -> None:
        """Prepare for a session. name: the name of the log. The other arguments are as in `Rounds`."""
        super().__init__(mapper, record, settings.live.search_from, patient)
        self._counters, self._name = counters, name

    def _request(self) -> NamesRequest | None:
        """Return the drive so far. Return None if all names agree with their landmarks, or if the session has too many
        boxes."""
        m = self._mapper.state
        if m.settings.association.method != "auto" or not m.kinds.are_names:
            return None
        if len(m.rays.owner) > m.settings.live.reassociate or (m.by_label and not contradicted(m).any()):
            return None
        found = collect(m, self._name, running=True)
        return NamesRequest(found, tuple(one.camera for one in found.log.cameras), m.given) if len(found.rays) else None

    def _correction(self, number: int, answer: NamesMessage | None) -> NamesMessage | None:
        m = self._mapper.state
        kinds = m.kinds
        if answer is None or not kinds.are_names:
            return None
        doubted = (kinds.several - kinds.shown) | kinds.moving | set(m.landmarks.label[contradicted(m)].tolist())
        changes = (
            not doubted.isdisjoint(answer.names.tolist())
            or not (kinds.several | kinds.moving).issuperset(answer.several.tolist())
            or not kinds.moving.issuperset(answer.moving.tolist())
        )
        return replace(answer, keyframe=number) if changes else None

    def _take_up(self, correction: NamesMessage) -> None:
        m = self._mapper.state
        m.graph.refresh()
        m.read_positions()
        kinds, labels = m.kinds, m.landmarks.label
        moving = [label for label in correction.moving.tolist() if label not in kinds.moving]
        names = [label for label in correction.names.tolist() if label not in kinds.shown]
        again = [label for label in names if label in kinds.several | kinds.moving]
        gone = np.isin(labels, moving) | (np.isin(labels, again) & ~_firsts(m))
        for label in moving:
            m.note_moving(label)
        for label in correction.several.tolist():
            # A label that moved stays out of the running map. Its tracks would follow the rays that still move.
            if label not in kinds.several | kinds.moving:
                m.note_class(label, judged=True)
        for label in names:
            m.note_name(label)
        if gone.any():
            drop_landmarks(m, np.flatnonzero(gone))
        added = [label for label in again if _add(m, label)]
        if moving:
            self._counters.accept("labels of things that move", len(moving))
        if added or gone.any():
            m.graph.update()
            m.schedule.solved = 0  # So a full solve comes soon. It tests which rays now agree.
            m.schedule.relinearise_soon()
            m.solve_corrected()


def _firsts(m: MapState) -> Bools:
    """Return which landmarks (N,) have the most observations of all landmarks of their label."""
    landmarks = m.landmarks
    order = np.lexsort((landmarks.id, -landmarks.seen, landmarks.label))
    first = np.zeros(len(landmarks), dtype=bool)
    first[order[np.unique(landmarks.label[order], return_index=True)[1]]] = True
    return first


def _add(m: MapState, label: int) -> bool:
    """Give the landmark of a name all free rays of its label. If the name has no landmark, make one. Return whether one was
    made."""
    mine = _best(m, label)
    free = mine[m.rays.owner[mine] < 0]
    rows = np.flatnonzero(m.landmarks.label == label)
    if len(rows):
        m.rays.owner[free] = m.landmarks.id[rows[0]]
        return False
    if len(free) < m.settings.live.min_rays:
        return False
    obs = m.sight(free)
    fit = fit_if_observable(obs, m.settings.live.min_rays, _AGREE, m.settings, m.rng, slack=_SLACK)
    if fit is None:
        return False
    k = m.keyframes
    at = np.searchsorted(k.id, m.rays.keyframe[free])
    last = at[k.stamp[at].argmax()]
    add_landmark(m, free, fit, obs, (float(k.stamp[at].min()), float(k.stamp[last])), k.drift[last])
    m.tracks = [track for track in m.tracks if track.label != label]
    return True


def _best(m: MapState, label: int) -> Ints:
    """Return the row of the ray with the highest score among the rays of a label, for each keyframe that has such rays."""
    at = np.flatnonzero(m.rays.label == label)
    order = at[np.lexsort((at, -m.rays.score[at], m.rays.keyframe[at]))]
    return np.sort(order[np.unique(m.rays.keyframe[order], return_index=True)[1]])
