"""Snapshots of the map. They take milliseconds, because only objects seen since the last snapshot are described again."""

import time
from dataclasses import replace

import numpy as np

from objslam.core.arrays import Floats
from objslam.core.geometry import interpolate, inverse
from objslam.core.object_map import MapObject, ObjectMap
from objslam.core.snapshot import CameraFrame, Snapshot
from objslam.core.trajectory import Trajectory
from objslam.graph.maps.live_prior_map import covariance_in_map, map_T_graph
from objslam.live.bodies.description import BodyEstimator
from objslam.live.mapper.landmark_table import LandmarkTable, covariances
from objslam.live.mapper.state import MapState
from objslam.live.mapper.tracks import Track
from objslam.live.names.contradicted import contradicted
from objslam.live.session.landmark_description import describe_landmark, describe_track
from objslam.live.session.map_scale import scale_covariances

_BUDGET = 0.012  # The time limit of a snapshot, s. A larger value delays frames. A smaller value keeps older descriptions.


class Describer:
    """Describes the objects of a map, and keeps each description until its object is seen again."""

    def __init__(self, bodies: BodyEstimator | None = None) -> None:
        """Prepare for a session. bodies: gives bodies to the landmarks. With None, all landmarks are points."""
        self._bodies = bodies
        # By landmark id: the number of its rays, its last stamp, s, and whether its name was contradicted, when it was
        # described, and the description.
        self._described: dict[int, tuple[tuple[int, float, bool], MapObject]] = {}
        self._covariances: dict[int, Floats] = {}  # By landmark id: the covariance (3, 3), m^2, in the graph.
        # By track id: the number of its rays when it was described, and the description.
        self._waiting: dict[int, tuple[int, MapObject]] = {}
        self._tied = False  # Whether the covariances of the descriptions are relative to a prior map.

    def map(self, m: MapState, whole: bool = False) -> ObjectMap:
        """Return first the landmarks, in the order of ids, and then the tracks with enough rays, as unresolved objects.

        After the time budget is spent, objects keep their last description, but landmarks get their present position. A new
        landmark gets a preliminary covariance: the covariance from its rays plus the widest covariance of the other
        landmarks. New tracks are left out. At least one covariance comes from the graph, however busy the machine is.
        Without it, no covariance would contain the error of the path. whole: whether to ignore the time budget.
        """
        end = np.inf if whole else time.perf_counter() + _BUDGET
        m.graph.refresh()
        if self._tied != (map_T_graph(m.graph) is not None):
            self._tied, self._described, self._covariances = not self._tied, {}, {}
        landmarks, known = m.landmarks, self._described
        points = m.graph.points(landmarks.id)
        found: dict[int, tuple[tuple[int, float, bool], MapObject]] = {}
        against, widest = contradicted(m), None
        described_at = np.array([known[j][0][1] if j in known else -np.inf for j in landmarks.id.tolist()])
        order = np.lexsort((-landmarks.id, described_at))  # New landmarks come newest first, as their path error is largest.
        for row in order.tolist():
            j = int(landmarks.id[row])
            sure = not against[row]
            state = (int(landmarks.seen[row]), float(landmarks.last[row]), sure)
            before, late = known.get(j), time.perf_counter() > end
            if late and before is None and widest is None:
                widest = self._widest(landmarks)
            if before is not None and (before[0] == state or late):
                described, state = before[1].at(points[row]), before[0]
            elif late and widest is not None:
                alone = covariances(landmarks, np.array([row]))[0]
                described = describe_landmark(m, row, points[row], alone + widest, sure=sure)
                state = (-1, -np.inf, sure)
            else:
                self._covariances[j] = self._covariance(m, j)
                described = describe_landmark(m, row, points[row], self._covariances[j], from_graph=True, sure=sure)
            found[j] = (state, described)
        self._described = found
        objects = [found[j][1] for j in sorted(found)]
        if self._bodies is not None:
            resolved = (o.id for o in objects if o.status == "ok")
            self._covariances = {j: self._covariances[j] for j in resolved if j in self._covariances}
            if not whole:
                self._bodies.update(m, self._covariances)
            turned = set(landmarks.id[landmarks.shape > 0].tolist())
            objects = [self._bodies.described(o, o.id in turned) for o in objects]
        objects = _of_unknown_scale(m, objects)
        first = int(landmarks.id.max(initial=-1)) + 1
        waiting = [track for track in m.tracks if len(track.rays) >= m.settings.live.min_rays]
        now = {track.id: self._wait(m, track, whole, end) for track in waiting}
        self._waiting = {number: entry for number, entry in now.items() if entry is not None}
        objects += [replace(o, id=first + i) for i, (_, o) in enumerate(self._waiting.values())]
        return ObjectMap(tuple(objects))

    def _widest(self, landmarks: LandmarkTable) -> Floats | None:
        """Return the widest covariance (3, 3), m^2, that the graph gave for a landmark, or None if it gave none. It contains
        the error of the path. A covariance from the rays of a new landmark does not."""
        known = [self._covariances[j] for j in landmarks.id.tolist() if j in self._covariances]
        return max(known, key=lambda one: np.nan_to_num(np.trace(one), nan=-1.0), default=None)

    def _covariance(self, m: MapState, j: int) -> Floats:
        """Return the covariance (3, 3), m^2, of landmark j, along the axes of the session.

        If the session is tied to a prior map and the covariance relative to this map is known, it is returned. Else the
        covariance is relative to the frame of the session.
        """
        covariance = covariance_in_map(m.graph, j) if self._tied else np.full((3, 3), np.nan)
        return covariance if np.isfinite(covariance).all() else m.graph.point_covariance(j)

    def _wait(self, m: MapState, track: Track, whole: bool, end: float) -> tuple[int, MapObject] | None:
        """Return the number of rays and the description of a track. Return None for a new track after the time `end`, s."""
        before = self._waiting.get(track.id)
        if not whole and ((before is not None and before[0] == len(track.rays)) or time.perf_counter() > end):
            return before
        return len(track.rays), describe_track(m, track)


def _of_unknown_scale(m: MapState, objects: list[MapObject]) -> list[MapObject]:
    """Return the objects with the covariances that the unknown scale of the map adds."""
    more = scale_covariances(m, np.array([o.position for o in objects]).reshape(-1, 3))
    if not more.any():
        return objects
    return [
        o if o.covariance is None else replace(o, covariance=o.covariance + one)
        for o, one in zip(objects, more, strict=True)
    ]


def take_snapshot(m: MapState, describer: Describer, lag: float, whole: bool) -> Snapshot:
    """Return a snapshot of a map. lag: `Snapshot.lag`, s. whole: whether to ignore the time budget of the descriptions."""
    return Snapshot(
        stamp=float(m.keyframes.stamp.max()) if len(m.keyframes) else np.nan,
        map=describer.map(m, whole),
        path=_path(m),
        frames=_frames(m),
        keyframes=m.next_id.keyframe,
        rebuilds=m.graph.rebuilds,
        lag=lag,
        update=m.counters.update(),
        counters=m.counters.accepted(),
        dropped=m.counters.dropped(),
        calibration=m.calibration,
        map_T_odom=_map_T_odom(m),
    )


def _path(m: MapState) -> Trajectory:
    """Return the path map_T_base of all keyframes, as the graph estimated it at its last refresh."""
    k = m.keyframes
    stamps, first = np.unique(k.stamp, return_index=True)
    return Trajectory(stamps, m.graph.poses(k.id[first]) @ inverse(k.base_T_camera[first]))


def _map_T_odom(m: MapState) -> Floats | None:
    """Return `Snapshot.map_T_odom` (4, 4) for the odometry as it was received, because tf has the received odometry. Return
    None in a gap of the odometry."""
    k, driven = m.keyframes, m.course.driven
    if not len(k) or not len(driven):
        return None
    row = int(k.stamp.argmax())
    after = int(np.searchsorted(driven.stamp, k.stamp[row]))
    near = slice(max(after - 1, 0), after + 1)
    pose, inside = interpolate(driven.stamp[near], driven.pose[near], k.stamp[row : row + 1], m.settings.poses.max_gap)
    if not inside[0]:
        return None
    map_T_base = m.graph.pose(int(k.id[row])) @ inverse(k.base_T_camera[row])
    return np.asarray(map_T_base @ inverse(pose[0]))


def _frames(m: MapState) -> tuple[CameraFrame, ...]:
    """Return the newest keyframe of each camera, with the boxes of its rays."""
    found, k, r = [], m.keyframes, m.rays
    for number, camera in enumerate(m.cameras):
        mine = np.flatnonzero(k.camera == number)
        if not len(mine):
            continue
        row = int(mine[k.stamp[mine].argmax()])
        rays = np.flatnonzero(r.keyframe == k.id[row])
        owner = r.owner[rays]
        rejected = (owner >= 0) & ~r.used[rays]
        found.append(CameraFrame(float(k.stamp[row]), camera, m.graph.pose(int(k.id[row])), r.box[rays], owner, rejected))
    return tuple(found)
