"""Snapshots of the map. They take milliseconds, because only objects seen since the last snapshot are described again."""

import time
from dataclasses import replace

import numpy as np

from objslam.association.observations import MIN_DEPTH, Observations, extents
from objslam.association.refinement import normalised_residuals
from objslam.core.arrays import Floats, Ints
from objslam.core.geometry import interpolate, inverse, widest_angle
from objslam.core.object_map import MapObject, ObjectMap
from objslam.core.snapshot import CameraFrame, Snapshot
from objslam.core.status import reach, status_of
from objslam.core.types import Association, Trajectory
from objslam.graph.marginals import largest_sigma
from objslam.live.calibration.collected import offline_rays
from objslam.live.mapper.landmark_table import covariances
from objslam.live.mapper.state import MapState
from objslam.live.mapper.tracks import Track
from objslam.mapping.box_offsets import SizedRays, offset_covariance, sides_of

_BUDGET = 0.012  # The time for a snapshot, s. A larger value delays frames. A smaller value leaves more descriptions old.
_MOST = 200  # The most rays that describe an object. They are spread evenly over its rays. A larger number takes longer.
_FEW = 60  # The most rays that give the parallax of an object, as the widest angle of all pairs. More rays take longer.


class Describer:
    """Describes the objects of a map, and keeps each description until its object is seen again."""

    def __init__(self) -> None:
        self._described: dict[int, tuple[tuple[int, float], MapObject]] = {}
        self._waiting: dict[int, tuple[int, MapObject]] = {}

    def map(self, m: MapState, whole: bool = False) -> ObjectMap:
        """Return first the landmarks, in the order of ids, and then the tracks with enough rays, as unresolved objects.

        After the time budget is spent, objects keep their last description, but landmarks get their present position.
        New landmarks get a covariance from their rays alone, and new tracks are left out. whole: ignore the time budget.
        """
        end = np.inf if whole else time.perf_counter() + _BUDGET
        landmarks, known = m.landmarks, self._described
        m.graph.refresh()
        points = m.graph.points(landmarks.id)
        found: dict[int, tuple[tuple[int, float], MapObject]] = {}
        order = np.argsort([known[j][0][1] if j in known else -np.inf for j in landmarks.id.tolist()], kind="stable")
        for row in order.tolist():
            j = int(landmarks.id[row])
            state = (int(landmarks.seen[row]), float(landmarks.last[row]))
            before = known.get(j)
            if before is not None and (before[0] == state or time.perf_counter() > end):
                described, state = replace(before[1], position=points[row]), before[0]
            elif time.perf_counter() > end:  # a new landmark, for which the rays alone give a covariance for now
                described = _landmark(m, row, points[row], covariances(landmarks, np.array([row]))[0], False)
                state = (-1, -np.inf)
            else:
                described = _landmark(m, row, points[row], m.graph.point_covariance(j), True)
            found[j] = (state, described)
        self._described = found
        objects = [found[j][1] for j in sorted(found)]
        first = int(landmarks.id.max(initial=-1)) + 1
        waiting = [track for track in m.tracks if len(track.rays) >= m.settings.live.min_rays]
        now = {track.id: self._wait(m, track, whole, end) for track in waiting}
        self._waiting = {number: entry for number, entry in now.items() if entry is not None}
        objects += [replace(o, id=first + i) for i, (_, o) in enumerate(self._waiting.values())]
        return ObjectMap(tuple(objects))

    def _wait(self, m: MapState, track: Track, whole: bool, end: float) -> tuple[int, MapObject] | None:
        """Return the number of rays and the description of a track; None for a new track after time `end`, s."""
        before = self._waiting.get(track.id)
        if not whole and ((before is not None and before[0] == len(track.rays)) or time.perf_counter() > end):
            return before
        return len(track.rays), _track(m, track)


def take_snapshot(m: MapState, describer: Describer, lag: float, whole: bool) -> Snapshot:
    """Return a snapshot of a map. lag: as in `Snapshot`, s. whole: as in `Describer.map`."""
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
    """Return map_T_base of all keyframes by the estimate at the graph's last refresh."""
    k = m.keyframes
    stamps, first = np.unique(k.stamp, return_index=True)
    return Trajectory(stamps, m.graph.poses(k.id[first]) @ inverse(k.base_T_camera[first]))


def _map_T_odom(m: MapState) -> Floats | None:
    """Return `Snapshot.map_T_odom`. The odometry is the received one, with its errors, as tf has no other."""
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


def _landmark(m: MapState, row: int, position: Floats, covariance: Floats, from_graph: bool) -> MapObject:
    landmarks, rays, j = m.landmarks, m.rays, int(m.landmarks.id[row])
    mine = np.flatnonzero((rays.owner == j) & rays.used)
    count = len(mine)
    some = _spread(mine, _MOST)
    wider = max(1.0, float(landmarks.squared[row]) / (2 * max(int(landmarks.seen[row]), 1)))
    covariance = wider * covariance
    obs = m.sight(some)
    parallax = widest_angle(m.sight(_spread(mine, _FEW)).direction)
    limits, away = m.settings.triangulation, reach(position, obs.origin)
    sigma = float(largest_sigma(covariance[None])[0])
    if from_graph and sigma > limits.max_rel_sigma * away:  # This sigma may include the drift of the map.
        seen = m.graph.seen_covariance(j, int(rays.keyframe[mine].max()))
        sigma = float(largest_sigma(wider * seen[None])[0])
    status = status_of(sigma, away, count, parallax, bool(np.isfinite(obs.range).any()), limits)
    fixed, extent = status == "ok", _extent(m, some, position) if count else None
    if fixed and extent is not None:
        covariance = covariance + _offsets(m, some, obs, position, np.array(extent))
    return MapObject(
        id=j,
        label=m.labels[int(landmarks.label[row])],
        position=position,
        covariance=covariance if fixed else None,
        status=status,
        rays=count,
        frames=len(np.unique(rays.keyframe[mine])),
        parallax_deg=round(float(np.degrees(parallax)), 3),
        rms_deg=_rms_deg(obs, position) if count else 0.0,
        first_seen=float(landmarks.first[row]),
        last_seen=float(landmarks.last[row]),
        extent=extent,
        ray=None if fixed or not count else (obs.origin[-1], obs.direction[-1]),
    )


def _track(m: MapState, track: Track) -> MapObject:
    obs = track.sight(m.graph)
    position = track.position if not track.by_label else obs.origin[-1] + 1.0 * obs.direction[-1]
    return MapObject(
        id=-1,
        label=m.labels[track.label],
        position=position,
        covariance=None,
        status="unresolved",
        rays=len(obs),
        frames=len(obs),
        parallax_deg=round(float(np.degrees(widest_angle(obs.direction))), 3),
        rms_deg=_rms_deg(obs, position),
        first_seen=track.first,
        last_seen=track.last,
        ray=(obs.origin[-1], obs.direction[-1]),
    )


def _spread(rows: Ints, most: int) -> Ints:
    return rows[np.linspace(0, len(rows) - 1, min(len(rows), most)).astype(np.int64)]


def _rms_deg(obs: Observations, position: Floats) -> float:
    off = np.minimum(normalised_residuals(obs, position) * obs.sigma, np.pi)
    return round(float(np.degrees(np.sqrt(np.mean(off**2)))), 4)


def _offsets(m: MapState, at: Ints, obs: Observations, position: Floats, extent: Floats) -> Floats:
    """Return the covariance (3, 3), m^2, that the box offsets add to a position. The settings give the offsets' share.

    at: the rows of the object's rays. obs: these rays in the map.
    """
    share = m.settings.rays.box_sigma
    if share == 0:
        return np.zeros((3, 3))
    distance = np.maximum(np.linalg.norm(position - obs.origin, axis=1), MIN_DEPTH)
    size = np.full(len(at), np.sqrt(extent.prod())) / distance
    along = np.where(np.isfinite(obs.range), 1 / obs.range_sigma, 0.0)
    one = np.zeros(len(at), dtype=np.int64)
    rays = SizedRays(one, obs.origin, obs.direction, distance, obs.sigma, size, along)
    return offset_covariance(sides_of(rays, position[None])[0], extent, share)


def _extent(m: MapState, at: Ints, position: Floats) -> tuple[float, float] | None:
    """Return the width and height, m, of an object at a position; None if unknown. at: the rows of its rays."""
    row = np.searchsorted(m.keyframes.id, m.rays.keyframe[at])
    frames, index = np.unique(row, return_inverse=True)
    poses = m.graph.poses(m.keyframes.id[frames])
    one = Association(np.zeros(len(at), dtype=np.int64), np.zeros(1, dtype=np.int64))
    rays = offline_rays(m, at, index)
    width, height = extents(rays, one, position[None], poses, m.keyframe_arrays(frames), tuple(m.cameras))[0].tolist()
    return (width, height) if np.isfinite([width, height]).all() else None
