"""Searches the boxes of a running session that belong to no object, in rounds.

A robot that turns sees a thing for a second, and minutes later again from another place. No such view alone gives a
position, and the tracks of two views do not meet before the path is right. The offline association joins them: it solves the
whole drive.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from objslam.association.single_object_fit import PointFit, fit_point
from objslam.config import Settings
from objslam.core.arrays import Bools, Ints
from objslam.core.camera import Camera
from objslam.core.diagnostics import Ledger
from objslam.live.calibration.collected import Collected, collect
from objslam.live.counters import Counters
from objslam.live.mapper.landmark_update import drop_landmarks
from objslam.live.mapper.mapper import Mapper
from objslam.live.mapper.state import MapState
from objslam.live.mapper.track_promotion import add_landmark
from objslam.live.rounds import Rounds
from objslam.sources.journal.corrections import ObjectsMessage

_GROWTH = 1.5
"""A search begins when the number of keyframes has grown by this factor since the last one began. A larger factor searches
more rarely, and takes less time."""
_DELAY = 0.15
"""The objects join the map when the number of keyframes has grown by this share since the search began. A larger share suits
slower machines, but shows the objects later."""
_NEW = 0.5
"""An object is new if less than this share of its rays belongs to landmarks of the session. A larger share adds more objects
beside landmarks."""
_GONE = 0.1
"""A landmark is no object if the offline association gives at most this share of its rays to objects. Things that move and
false boxes end so. A larger share drops more landmarks."""
_RIGHT = 0.7
"""An association drops landmarks only if it gives at least this share of the rays of all landmarks to objects. With a
smaller share, a solve that went wrong may drop right landmarks."""
_BEND = 0.2
"""The standard deviation (m) of camera poses from several views of an object, before the object joins them. A larger one
keeps more rays for its first position."""


@dataclass(frozen=True)
class SearchRequest:
    """The drive of a session so far. owner: (R,) the session's landmark of each of its rays, -1 without one. classes: (R,)
    whether the label of a ray may have several objects."""

    found: Collected
    owner: Ints
    classes: Bools
    cameras: tuple[Camera, ...]
    settings: Settings

    def solve(self) -> ObjectsMessage:
        """Associate and solve the drive as at the end of the session. Return the objects that the session has not found, and
        its landmarks that are none. The caller puts in the keyframe, which is 0 here. An object with little parallax is left
        out, because later views would not fit its first position. Raises SolveError if the solve fails."""
        from objslam.graph.init_unknown_correspondences import InitialEstimate
        from objslam.mapping.alternation import solve
        from objslam.mapping.corrected import corrected
        from objslam.mapping.describe import describe

        f, ledger = self.found, Ledger()
        start = InitialEstimate(f.map_T_camera, f.association, f.positions)
        solution = solve(f.keyframes, f.rays, self.cameras, self.settings, ledger, lambda *_: None, start, f.errors)
        if solution.errors is not None:
            solution, _ = corrected(solution, solution.errors, ledger)
        objects, _ = describe(solution, self.cameras, self.settings)
        used, new = solution.estimate.weight > 0, []
        for j, one in enumerate(objects.objects):
            mine = used & (solution.association.object == j) & self.classes
            placed = one.parallax_deg >= self.settings.joint.min_parallax_deg or bool(np.isfinite(f.rays.range[mine]).any())
            if one.status == "ok" and placed and mine.any() and (self.owner[mine] >= 0).mean() < _NEW:
                new.append(np.sort(f.numbers[mine & (self.owner < 0)]))
        gone = no_objects(self.owner, used & (solution.association.object >= 0))
        return ObjectsMessage(0, tuple(new), gone[np.isin(gone, self.owner[self.classes])])


def no_objects(owner: Ints, explained: Bools) -> Ints:
    """Return the ids (n,) of landmarks that are no objects (`_GONE`).

    owner: (R,) the landmark of each ray, -1 without one. explained: (R,) whether the offline association gives a ray to an
    object.
    """
    held = owner >= 0
    if not held.any() or explained[held].mean() < _RIGHT:
        return np.zeros(0, dtype=np.int64)
    ids, index = np.unique(owner[held], return_inverse=True)
    return np.asarray(ids[np.bincount(index, explained[held]) <= _GONE * np.bincount(index)])


class ObjectSearch(Rounds[ObjectsMessage, ObjectsMessage]):
    """Searches for objects in rounds, and adds them to the map."""

    growth, delay, quick, told = _GROWTH, _DELAY, False, ObjectsMessage

    def __init__(
        self,
        settings: Settings,
        counters: Counters,
        mapper: Mapper,
        record: Callable[[ObjectsMessage], bool],
        name: str,
        patient: bool,
    ) -> None:
        """Prepare for a session. name: the name of the log. The other arguments are as in `Rounds`."""
        super().__init__(mapper, record, settings.live.search_from, patient)
        self._counters, self._name = counters, name

    def _request(self) -> SearchRequest | None:
        """Return the drive so far. None if no label has several objects, if all of their boxes belong to objects, or if
        there are too many boxes."""
        m = self._mapper.state
        classes = m.kinds.classes(m.rays.label)
        free = (m.rays.owner < 0) & classes
        if not classes.any() or not len(m.landmarks) or free.sum() < m.settings.live.min_rays:
            return None
        if len(free) > m.settings.live.reassociate:
            return None
        found = collect(m, self._name, count_dropped=False)
        at = np.searchsorted(m.rays.number, found.numbers)
        return SearchRequest(found, m.rays.owner[at], classes[at], tuple(one.camera for one in found.log.cameras), m.given)

    def _correction(self, number: int, answer: ObjectsMessage | None) -> ObjectsMessage | None:
        if answer is None:
            self._counters.accept("searches for objects given up")
        return replace(answer, keyframe=number) if answer is not None and (answer.rays or len(answer.gone)) else None

    def _take_up(self, correction: ObjectsMessage) -> None:
        m = self._mapper.state
        gone = m.rows_of(correction.gone[np.isin(correction.gone, m.landmarks.id)])
        if len(gone):
            drop_landmarks(m, gone)
            self._counters.accept("landmarks that are no objects", len(gone))
        added = add_objects(m, correction)
        if added:
            self._counters.accept("objects found in earlier boxes", added)


def add_objects(m: MapState, found: ObjectsMessage) -> int:
    """Add these objects to the map, with those of their rays that still belong to no landmark. Return how many were added.

    The graph then takes their rays as they are: the views of an object may disagree, because nothing held the path between
    them. A solve bends the path, and later tests find the outliers. An object near a landmark of its label is left out,
    because it may be this landmark. If not, the end of the session finds it.
    """
    m.graph.refresh()
    m.read_positions()
    k, added = m.keyframes, 0
    for numbers in found.rays:
        at = np.flatnonzero(np.isin(m.rays.number, numbers) & (m.rays.owner < 0))
        obs = m.sight(at)
        fit = fit_point(obs, m.rng, _BEND) if len(at) >= m.settings.live.min_rays else None
        if fit is None or _is_near_another(m, fit, int(m.rays.label[at[0]])):
            continue
        rows = np.searchsorted(k.id, m.rays.keyframe[at])
        last = rows[k.stamp[rows].argmax()]
        whole = replace(fit, inlier=np.ones(len(at), dtype=bool))
        add_landmark(m, at, whole, obs, (float(k.stamp[rows].min()), float(k.stamp[last])), k.drift[last])
        added += 1
    if added:
        _release(m)
        m.graph.update()
        m.schedule.relinearise_soon()
        m.solve_corrected()
    return added


def _is_near_another(m: MapState, fit: PointFit, label: int) -> bool:
    """Return whether a landmark of this label is so near to a point that the two may be one object."""
    apart = np.linalg.norm(m.landmarks.position[m.landmarks.label == label] - fit.position, axis=1)
    return bool((apart <= m.settings.association.duplicate_distance).any())


def _release(m: MapState) -> None:
    """Take the rays of landmarks out of the tracks. A track that loses more than half of its rays goes."""
    owned = set(m.rays.number[m.rays.owner >= 0].tolist())
    kept = []
    for track in m.tracks:
        rays = [ray for ray in track.rays if ray[0] not in owned]
        if 2 * len(rays) >= len(track.rays) and rays:
            track.rays = rays
            kept.append(track)
    m.tracks = kept
