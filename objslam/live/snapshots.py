"""The map as of now, in milliseconds: only the objects that were seen since the last time are described anew."""

from __future__ import annotations

import time
from dataclasses import replace

import numpy as np

from objslam.association.extent import extents
from objslam.geometry import inverse, widest_angle
from objslam.live.candidates import Candidate
from objslam.live.interface import Frame
from objslam.live.known import covariances
from objslam.live.mapper import Mapper
from objslam.live.meeting import misses, sightings
from objslam.types import Association, Floats, Ints, Keyframes, MapObject, ObjectMap, Rays, Trajectory

_BUDGET = 0.012  # s
_MOST = 200  # rays of an object that it is described by
_FEW = 60  # and for its parallax


class Describer:
    """Remembers what it said of each object."""

    def __init__(self) -> None:
        self._said: dict[int, tuple[tuple[int, float], MapObject]] = {}
        self._waiting: dict[int, tuple[int, MapObject]] = {}

    def map(self, m: Mapper, whole: bool = False) -> ObjectMap:
        """Objects with covariance and status, by their ids; candidates with enough boxes come after them, unresolved.

        Unless the whole is asked for, what takes longer than a frame may is left for the next time: an object then goes by
        what was said of it last, at its new place.
        """
        end = np.inf if whole else time.perf_counter() + _BUDGET
        known = m.known
        m.graph.refresh()
        points = m.graph.points(known.id)
        objects, said = [], {}
        order = np.argsort([self._said[j][0][1] if j in self._said else -np.inf for j in known.id.tolist()], kind="stable")
        for row in order.tolist():
            j = int(known.id[row])
            state = (int(known.seen[row]), float(known.last[row]))
            before = self._said.get(j)
            if before is not None and (before[0] == state or time.perf_counter() > end):
                described, state = replace(before[1], position=points[row]), before[0]
            elif time.perf_counter() > end:  # new: with the covariance that its rays alone give, for now
                described = self._describe(m, row, j, points[row], covariances(known, np.array([row]))[0])
                state = (-1, -np.inf)
            else:
                described = self._describe(m, row, j, points[row], m.graph.point_covariance(j))
            said[j] = (state, described)
            objects.append(described)
        self._said = said
        objects.sort(key=lambda o: o.id)
        first = int(known.id.max(initial=-1)) + 1
        waiting = [c for c in m.candidates if len(c) >= m.settings.live.min_rays]
        now = {c.id: self._wait(m, c, whole, end) for c in waiting}
        self._waiting = {number: said for number, said in now.items() if said is not None}
        objects += [replace(o, id=first + i) for i, (_, o) in enumerate(self._waiting.values())]
        return ObjectMap(tuple(objects))

    def _wait(self, m: Mapper, candidate: Candidate, whole: bool, end: float) -> tuple[int, MapObject] | None:
        """A candidate, and with how many rays; one that was not seen since is as it was, a new one may have to wait."""
        before = self._waiting.get(candidate.id)
        if not whole and ((before is not None and before[0] == len(candidate)) or time.perf_counter() > end):
            return before
        return len(candidate), _waiting(m, candidate)

    def _describe(self, m: Mapper, row: int, j: int, position: Floats, covariance: Floats) -> MapObject:
        known, rays = m.known, m.rays
        mine = np.flatnonzero((rays.owner == j) & rays.used)
        count = len(mine)
        some = mine[np.linspace(0, count - 1, min(count, _MOST)).astype(np.int64)] if count else mine
        few = mine[np.linspace(0, count - 1, min(count, _FEW)).astype(np.int64)] if count else mine
        covariance = covariance * max(1.0, float(known.squared[row]) / (2 * max(int(known.seen[row]), 1)))
        origin, direction, index = _in_map(m, some)
        s = sightings(origin, direction, rays.sigma[some], rays.range[some], rays.range_sigma[some])
        off = misses(s, position) * s.sigma if count else np.zeros(1)
        parallax = float(np.degrees(widest_angle(_in_map(m, few)[1])))
        ranged = bool(np.isfinite(rays.range[some]).any())
        limit = m.settings.triangulation
        fixed = np.isfinite(covariance).all() and (ranged or parallax >= limit.min_parallax_deg)
        size = _size(m, some, index, position) if count else None
        return MapObject(
            id=j,
            label=m.labels[int(known.label[row])],
            position=position,
            covariance=covariance if fixed else None,
            status="ok" if fixed else "unresolved",
            rays=count,
            frames=len(np.unique(rays.keyframe[mine])),
            parallax_deg=round(parallax, 3),
            rms_deg=round(float(np.degrees(np.sqrt(np.mean(np.minimum(off, np.pi) ** 2)))), 4),
            first_seen=float(known.first[row]),
            last_seen=float(known.last[row]),
            extent=size,
            ray=None if fixed or not count else (origin[-1], direction[-1]),
        )


def path(m: Mapper) -> Trajectory:
    """map_T_base of all keyframes, as the graph has them now."""
    k = m.keyframes
    m.graph.refresh()
    stamps, first = np.unique(k.stamp, return_index=True)
    poses = m.graph.poses(k.id[first]) @ inverse(k.base_T_camera[first])
    return Trajectory(stamps, poses)


def frames(m: Mapper) -> tuple[Frame, ...]:
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
        found.append(Frame(float(k.stamp[row]), camera, m.graph.pose(int(k.id[row])), r.box[rays], owner, rejected))
    return tuple(found)


def _waiting(m: Mapper, candidate: Candidate) -> MapObject:
    s = candidate.sight(m.graph)
    position = candidate.position if not candidate.by_label else s.origin[-1] + 1.0 * s.direction[-1]
    off = np.minimum(misses(s, position) * s.sigma, np.pi)
    return MapObject(
        id=-1,
        label=m.labels[candidate.label],
        position=position,
        covariance=None,
        status="unresolved",
        rays=len(s),
        frames=len(s),
        parallax_deg=round(float(np.degrees(widest_angle(s.direction))), 3),
        rms_deg=round(float(np.degrees(np.sqrt(np.mean(off**2)))), 4),
        first_seen=candidate.first,
        last_seen=candidate.last,
        ray=(s.origin[-1], s.direction[-1]),
    )


def _in_map(m: Mapper, at: Ints) -> tuple[Floats, Floats, Ints]:
    """Origins and directions (n, 3) of rays, and the row (n,) of the keyframe of each."""
    poses = m.graph.poses(m.rays.keyframe[at])
    row = np.searchsorted(m.keyframes.id, m.rays.keyframe[at])
    return poses[:, :3, 3], np.einsum("rij,rj->ri", poses[:, :3, :3], m.rays.direction[at]), row


def _size(m: Mapper, at: Ints, row: Ints, position: Floats) -> tuple[float, float] | None:
    rays, frames = m.rays, np.unique(row)
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
