"""Find a session in the map of another day, and tie it to that map.

The search runs after keyframes, in the thread of the session. It depends only on the map of the session, so a resumed
session finds the same place.
"""

from dataclasses import dataclass, replace

import numpy as np

from objslam.association.registration.map_registration import Registration
from objslam.association.registration.object_maps import reason, register
from objslam.core.arrays import Floats, Ints
from objslam.core.object_map import MapObject, ObjectMap
from objslam.core.snapshot import InPriorMap, Snapshot
from objslam.core.trajectory import Trajectory
from objslam.frontend.up import on_its_side
from objslam.graph.maps.live_prior_map import map_T_graph, tie_frame, tie_objects, untie
from objslam.graph.maps.prior_map import beyond
from objslam.live.counters import Counters
from objslam.live.mapper.mapper import Mapper
from objslam.live.mapper.state import MapState
from objslam.live.mapper.tracks import update_positions
from objslam.live.session.landmark_description import describe_landmark
from objslam.mapping.localization import PriorMap, at_ray_points, moved_object

_EVERY, _AT = 10, 9
"""The period of searches in keyframes, and the keyframe of each period with a search. With a longer period, the session is
found later. `_AT` differs from the keyframes with maintenance, so that search and maintenance do not delay the same
frame."""
_MOST = 40
"""The most landmarks in a search. They are the ones seen last. A larger number delays the next frame for longer. A search
with 40 landmarks in a map of 1,000 objects takes 0.1 s."""
_GROWTH = 1.2
"""The factor by which the number of keyframes grows before a search with the same landmarks is repeated. By then, the
landmarks are more exact. A larger factor searches more rarely."""
_SAME_PLACE = 0.5
"""The shift, m, of the middle of the matched landmarks above which a new registration replaces the old one. A larger value
keeps a wrong place for longer."""


@dataclass(frozen=True)
class _Search:
    """A search that was made: the ids of its landmarks, and the number of keyframes when it was made."""

    landmarks: tuple[int, ...]
    keyframes: int


class MapLocator:
    """Searches for a session in a prior map after keyframes. Without a prior map, it does nothing.

    told: the outcome of the last search, or None before the first search.
    """

    def __init__(self, known: PriorMap | None, mapper: Mapper, counters: Counters) -> None:
        self._known, self._mapper, self._counters = known, mapper, counters
        if known is not None:  # Landmarks are where rays meet. Objects of a map may be at the centres of bodies instead.
            self._known = replace(known, objects=at_ray_points(known.objects))
        self._last: _Search | None = None
        self._matched: dict[int, int] = {}  # The index of an object in the prior map, by the id of its landmark.
        self.told: InPriorMap | None = None

    def after_keyframe(self) -> bool:
        """Search if a search is due, and return whether it tied landmarks to the prior map."""
        m = self._mapper.state
        if self._known is None or m.next_id.keyframe % _EVERY != _AT or m.graph.is_rebuilding:
            return False
        rows = np.sort(np.argsort(-m.landmarks.last, kind="stable")[:_MOST])
        search = _Search(tuple(m.landmarks.id[rows].tolist()), m.next_id.keyframe)
        self._matched = {j: k for j, k in self._matched.items() if j in set(m.landmarks.id.tolist())}
        if not self._is_due(search):
            return False
        self._last = search
        objects, in_graph = _recent_objects(m, rows)
        found = register(objects, self._known.objects)
        if not found.accepted:
            if map_T_graph(m.graph) is None:
                why = on_its_side({"the map": self._known.up}) or reason(
                    found, objects, self._known.objects, ("the drive", "the map")
                )
                self.told = InPriorMap(0, f"not localised in {self._known.name} yet: {why}")
            return False
        return self._tie(found, objects, in_graph)

    def in_map(self, snapshot: Snapshot) -> Snapshot:
        """Return a snapshot with `told`, and in the frame of the prior map if the session is tied to one.

        Matched objects get their ids in the prior map. The first free id of the prior map is added to all other ids.
        """
        frame = map_T_graph(self._mapper.state.graph)
        snapshot = replace(snapshot, in_map=self.told)
        if frame is None:
            return snapshot
        objects = tuple(replace(moved_object(o, frame), id=self.id_in_map(o.id)) for o in snapshot.map.objects)
        frames = tuple(
            replace(one, map_T_camera=frame @ one.map_T_camera, objects=self._ids_in_map(one.objects))
            for one in snapshot.frames
        )
        assert self._known is not None
        return replace(
            snapshot,
            map=ObjectMap(objects, self._known.objects.frame),
            path=Trajectory(snapshot.path.stamps, frame @ snapshot.path.poses),
            frames=frames,
            map_T_odom=None if snapshot.map_T_odom is None else frame @ snapshot.map_T_odom,
        )

    def id_in_map(self, j: int) -> int:
        """Return the id in the prior map of the object that has the id j in the session."""
        assert self._known is not None
        known = self._matched.get(j)
        return self._known.first_free_id + j if known is None else self._known.objects[known].id

    def _ids_in_map(self, ids: Ints) -> Ints:
        return np.array([self.id_in_map(j) if j >= 0 else j for j in ids.tolist()], dtype=np.int64)

    def _is_due(self, search: _Search) -> bool:
        if len(search.landmarks) < 2 or set(search.landmarks) <= self._matched.keys():
            return False
        last = self._last
        return last is None or last.landmarks != search.landmarks or search.keyframes >= _GROWTH * last.keyframes

    def _tie(self, found: Registration, objects: ObjectMap, in_graph: Floats) -> bool:
        """Tie the matched objects to the prior map, and return whether anything new was tied.

        objects, in_graph: as `_recent_objects` returns them.
        """
        m, known = self._mapper.state, self._known
        assert known is not None
        frame, ids = map_T_graph(m.graph), np.array([o.id for o in objects], dtype=np.int64)
        if frame is not None and _apart(frame, found.b_T_a, objects.positions[found.matches[:, 0]]) > _SAME_PLACE:
            untie(m.graph)
            self._matched, frame = {}, None
            self._counters.accept("moves to another place in the prior map")
        is_new = frame is None
        if is_new:
            tie_frame(m.graph, found.b_T_a)
            self._counters.accept("moves into the frame of the prior map")
        taken = set(self._matched.values())
        pairs = [(i, k) for i, k in found.matches.tolist() if int(ids[i]) not in self._matched and k not in taken]
        if not pairs and not is_new:
            return False
        ours, theirs = np.array(pairs, dtype=np.int64).reshape(-1, 2).T
        own = beyond(objects.covariances[ours], in_graph[ours])
        tie_objects(m.graph, ids[ours], own, known.objects.positions[theirs], known.objects.covariances[theirs])
        self._matched |= dict(zip(ids[ours].tolist(), theirs.tolist(), strict=True))
        self._counters.accept("landmarks of the prior map", len(pairs))
        number, odds = len(self._matched), f"log odds {found.log_odds:.1f}, lead {found.lead:.1f}"
        self.told = InPriorMap(number, f"localised in {known.name} by {number} objects, {odds}")
        if is_new:
            m.rebuild_in_slices()
        m.schedule.relinearise_soon()
        m.graph.refresh()
        m.read_positions()
        update_positions([track for track in m.tracks if not track.by_label], m.graph)
        self._mapper.map_has_moved()
        return True


def _recent_objects(m: MapState, rows: Ints) -> tuple[ObjectMap, Floats]:
    """Return the resolved landmarks in rows (n,), and their covariances in the graph, m^2, one (3, 3) for each resolved
    landmark.

    The covariances are relative to the newest keyframe, because earlier drift moves all landmarks alike. This function does
    not change the state, because a search without a match must not change the map.
    """
    newest = int(m.keyframes.id[m.keyframes.stamp.argmax()])
    m.graph.refresh()
    turn, places = m.graph.pose(newest)[:3, :3], m.graph.points(m.landmarks.id[rows])
    described: list[tuple[MapObject, Floats]] = []
    for row, place in zip(rows.tolist(), places, strict=True):
        covariance = turn @ m.graph.seen_covariance(int(m.landmarks.id[row]), newest) @ turn.T
        if np.isfinite(covariance).all():
            described.append((describe_landmark(m, row, place, covariance), covariance))
    resolved = [(one, covariance) for one, covariance in described if one.status == "ok"]
    return ObjectMap(tuple(one for one, _ in resolved)), np.array([c for _, c in resolved]).reshape(-1, 3, 3)


def _apart(a: Floats, b: Floats, points: Floats) -> float:
    """Return the distance (m) between two images of the middle of points (n, 3): moved by `a` (4, 4), and moved by `b` (4,
    4)."""
    middle = np.append(points.mean(axis=0), 1.0)
    return float(np.linalg.norm((a @ middle - b @ middle)[:3]))
