"""The map as of now, in milliseconds: only objects that were seen since the last snapshot are described again."""

from __future__ import annotations

import time
from dataclasses import replace

import numpy as np

from objslam.association.observations import extents
from objslam.association.refinement import normalised_residuals
from objslam.core.arrays import Floats, Ints
from objslam.core.geometry import inverse, widest_angle
from objslam.core.object_map import MapObject, ObjectMap
from objslam.core.snapshot import CameraFrame, Snapshot
from objslam.core.status import reach, status_of
from objslam.core.types import Association, Keyframes, Rays, Trajectory
from objslam.graph.marginals import largest_sigma
from objslam.live.mapper.landmark_table import covariances
from objslam.live.mapper.state import MapState
from objslam.live.mapper.tracks import Track

_BUDGET = 0.012
"""s that a snapshot may take; longer keeps frames waiting, shorter leaves more objects as they were described last."""
_MOST = 200
"""Rays, evenly spread, that an object is described by; more take longer."""
_FEW = 60
"""Rays for its parallax, of which all pairs are looked at; more take longer."""


class Describer:
    """Remembers what it said of each object."""

    def __init__(self) -> None:
        self._said: dict[int, tuple[tuple[int, float], MapObject]] = {}
        self._waiting: dict[int, tuple[int, MapObject]] = {}

    def map(self, m: MapState, whole: bool = False) -> ObjectMap:
        """Objects with covariance and status, by their ids; tracks with enough boxes come after them, unresolved.

        Unless the whole is asked for, what takes longer than a frame may is left for the next time: an object then goes by
        what was said of it last, at its new place.
        """
        end = np.inf if whole else time.perf_counter() + _BUDGET
        landmarks = m.landmarks
        m.graph.refresh()
        points = m.graph.points(landmarks.id)
        objects, said = [], {}
        order = np.argsort(
            [self._said[j][0][1] if j in self._said else -np.inf for j in landmarks.id.tolist()], kind="stable"
        )
        for row in order.tolist():
            j = int(landmarks.id[row])
            state = (int(landmarks.seen[row]), float(landmarks.last[row]))
            before = self._said.get(j)
            if before is not None and (before[0] == state or time.perf_counter() > end):
                described, state = replace(before[1], position=points[row]), before[0]
            elif time.perf_counter() > end:  # new: with the covariance that its rays alone give, for now
                described = self._describe(m, row, j, points[row], covariances(landmarks, np.array([row]))[0], False)
                state = (-1, -np.inf)
            else:
                described = self._describe(m, row, j, points[row], m.graph.point_covariance(j), True)
            said[j] = (state, described)
            objects.append(described)
        self._said = said
        objects.sort(key=lambda o: o.id)
        first = int(landmarks.id.max(initial=-1)) + 1
        waiting = [track for track in m.tracks if len(track.rays) >= m.settings.live.min_rays]
        now = {track.id: self._wait(m, track, whole, end) for track in waiting}
        self._waiting = {number: said for number, said in now.items() if said is not None}
        objects += [replace(o, id=first + i) for i, (_, o) in enumerate(self._waiting.values())]
        return ObjectMap(tuple(objects))

    def _wait(self, m: MapState, track: Track, whole: bool, end: float) -> tuple[int, MapObject] | None:
        """A track, and with how many rays; one that was not seen since is as it was, a new one may have to wait."""
        before = self._waiting.get(track.id)
        if not whole and ((before is not None and before[0] == len(track.rays)) or time.perf_counter() > end):
            return before
        return len(track.rays), _waiting(m, track)

    def _describe(self, m: MapState, row: int, j: int, position: Floats, covariance: Floats, from_graph: bool) -> MapObject:
        landmarks, rays = m.landmarks, m.rays
        mine = np.flatnonzero((rays.owner == j) & rays.used)
        count = len(mine)
        some = mine[np.linspace(0, count - 1, min(count, _MOST)).astype(np.int64)] if count else mine
        few = mine[np.linspace(0, count - 1, min(count, _FEW)).astype(np.int64)] if count else mine
        wider = max(1.0, float(landmarks.squared[row]) / (2 * max(int(landmarks.seen[row]), 1)))
        covariance = wider * covariance
        obs = m.sight(some)
        off = normalised_residuals(obs, position) * obs.sigma if count else np.zeros(1)
        parallax = widest_angle(m.sight(few).direction)
        limits, away = m.settings.triangulation, reach(position, obs.origin)
        sigma = float(largest_sigma(covariance[None])[0])
        if from_graph and sigma > limits.max_rel_sigma * away:  # the map's own drift may be in it
            seen = m.graph.seen_covariance(j, int(rays.keyframe[mine].max()))
            sigma = float(largest_sigma(wider * seen[None])[0])
        status = status_of(sigma, away, count, parallax, bool(np.isfinite(obs.range).any()), limits)
        fixed = status == "ok"
        size = _size(m, some, position) if count else None
        return MapObject(
            id=j,
            label=m.labels[int(landmarks.label[row])],
            position=position,
            covariance=covariance if fixed else None,
            status=status,
            rays=count,
            frames=len(np.unique(rays.keyframe[mine])),
            parallax_deg=round(float(np.degrees(parallax)), 3),
            rms_deg=round(float(np.degrees(np.sqrt(np.mean(np.minimum(off, np.pi) ** 2)))), 4),
            first_seen=float(landmarks.first[row]),
            last_seen=float(landmarks.last[row]),
            extent=size,
            ray=None if fixed or not count else (obs.origin[-1], obs.direction[-1]),
        )


def take_snapshot(m: MapState, describer: Describer, lag: float, whole: bool) -> Snapshot:
    """The state of a session. lag: s. whole: as `Describer.map` has it."""
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
    )


def _path(m: MapState) -> Trajectory:
    """map_T_base of all keyframes, as the graph has them now."""
    k = m.keyframes
    m.graph.refresh()
    stamps, first = np.unique(k.stamp, return_index=True)
    poses = m.graph.poses(k.id[first]) @ inverse(k.base_T_camera[first])
    return Trajectory(stamps, poses)


def _frames(m: MapState) -> tuple[CameraFrame, ...]:
    """The newest keyframe of each camera, with the boxes that became rays."""
    m.graph.refresh()
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


def _waiting(m: MapState, track: Track) -> MapObject:
    obs = track.sight(m.graph)
    position = track.position if not track.by_label else obs.origin[-1] + 1.0 * obs.direction[-1]
    off = np.minimum(normalised_residuals(obs, position) * obs.sigma, np.pi)
    return MapObject(
        id=-1,
        label=m.labels[track.label],
        position=position,
        covariance=None,
        status="unresolved",
        rays=len(obs),
        frames=len(obs),
        parallax_deg=round(float(np.degrees(widest_angle(obs.direction))), 3),
        rms_deg=round(float(np.degrees(np.sqrt(np.mean(off**2)))), 4),
        first_seen=track.first,
        last_seen=track.last,
        ray=(obs.origin[-1], obs.direction[-1]),
    )


def _size(m: MapState, at: Ints, position: Floats) -> tuple[float, float] | None:
    rays = m.rays
    row = np.searchsorted(m.keyframes.id, rays.keyframe[at])
    frames = np.unique(row)
    poses = m.graph.poses(m.keyframes.id[frames])
    k = m.keyframes
    nothing = np.zeros(len(frames), dtype=np.int64)
    keyframes = Keyframes(k.stamp[frames], k.camera[frames], nothing, k.base_T_camera[frames], k.map_T_base[frames])
    some = Rays(
        keyframe=np.searchsorted(frames, row),
        direction=rays.direction[at],
        sigma=rays.sigma[at],
        range=rays.range[at],
        range_sigma=rays.range_sigma[at],
        label=rays.label[at],
        score=rays.score[at],
        box=rays.box[at],
        track_id=rays.track[at],
        label_names=tuple(m.labels),
    )
    one = Association(np.zeros(len(at), dtype=np.int64), np.zeros(1, dtype=np.int64))
    width, height = extents(some, one, position[None], poses, keyframes, tuple(m.cameras))[0].tolist()
    return (width, height) if np.isfinite([width, height]).all() else None
