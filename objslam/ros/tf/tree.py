"""Look up static and moving transforms in the tree of coordinate frames of /tf and /tf_static."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np

from objslam.core.arrays import Bools, Floats
from objslam.core.diagnostics import Ledger
from objslam.core.geometry import interpolate, inverse
from objslam.errors import LogError
from objslam.ros.messages.poses import PoseRows
from objslam.ros.tf.frames import MAX_GAP, MAX_TRANSFORMS, climb, link, part, unchanged

_NAMED = 6  # The largest number of frames that an error lists. The limit keeps the error readable.


@dataclass
class TfRows:
    """The transforms of a recording by (parent, child). moving: all transforms on /tf in the order of arrival.

    static: only the last transform on /tf_static. refused: the number of refused transforms by reason.
    """

    moving: dict[tuple[str, str], PoseRows] = field(default_factory=dict)
    static: dict[tuple[str, str], PoseRows] = field(default_factory=dict)
    refused: Counter[str] = field(default_factory=Counter)

    def add(self, transform: Any, logged: int, static: bool) -> None:
        """Add a geometry_msgs/TransformStamped. An invalid transform is only counted in `refused`. logged: its recording
        time, ns. static: whether it was on /tf_static."""
        try:
            parent, child = link(transform)
        except ValueError as error:
            self.refused[str(error)] += 1
            return
        table = self.static if static else self.moving
        rows = table.get((parent, child))
        if rows is None or static:
            if rows is None and len(self.static) + len(self.moving) >= MAX_TRANSFORMS:
                self.refused[f"transform beyond the first {MAX_TRANSFORMS} pairs of frames"] += 1
                return
            rows = table[parent, child] = PoseRows()
        stamp = transform.header.stamp
        nanoseconds = stamp.sec * 10**9 + stamp.nanosec
        rows.add(nanoseconds or logged, logged, transform.transform.translation, transform.transform.rotation)


@dataclass(frozen=True)
class _Edge:
    """The poses parent_T_child of a child frame at increasing timestamps (N,), s. A static frame has one pose (1, 4, 4)."""

    parent: str
    stamps: Floats
    poses: Floats

    @property
    def still(self) -> bool:
        return len(self.poses) == 1


class TfTree:
    """The tree of coordinate frames. A pose a_T_b transforms b coordinates to a coordinates.

    A frame with several parents keeps the parent with the most transforms. If transforms have equal timestamps, the last of
    them is used. Methods raise LogError if two frames are not connected, or if the frames form a cycle.
    """

    def __init__(self, rows: TfRows, ledger: Ledger) -> None:
        self._rows, self._ledger = rows, ledger
        self._edges: dict[str, _Edge] = {}
        self._parents: dict[str, Counter[str]] = {}
        for parent, child in rows.static:
            self._parents.setdefault(child, Counter())[parent] += 1
        for (parent, child), samples in rows.moving.items():
            self._parents.setdefault(child, Counter())[parent] += len(samples)
        self._parent = {child: max(found, key=lambda name: found[name]) for child, found in self._parents.items()}
        for reason, count in rows.refused.items():
            ledger.drop(reason, count)

    @cached_property
    def frames(self) -> frozenset[str]:
        """The names of all frames."""
        return frozenset(self._parent) | frozenset(self._parent.values())

    def chain(self, a: str, b: str) -> tuple[str, ...]:
        """Return the frames from a to b, including both."""
        up, down = self._ways(a, b)
        top = self._parent[up[-1]] if up else a
        return (*up, top, *reversed(down))

    def still(self, a: str, b: str) -> Floats | None:
        """Return a_T_b (4, 4), or None if this pose changes over time."""
        still = all(self._edge(child).still for way in self._ways(a, b) for child in way)
        return self.at(a, b, np.zeros(1))[0][0] if still else None

    def stamps(self, a: str, b: str) -> Floats:
        """Return the timestamps (N,), s, of all moving transforms between a and b. Timestamps outside the time range that
        all these transforms cover are left out."""
        moving = [edge for way in self._ways(a, b) for child in way if not (edge := self._edge(child)).still]
        if not moving:
            return np.zeros(0)
        stamps = np.unique(np.concatenate([edge.stamps for edge in moving]))
        first, last = max(edge.stamps[0] for edge in moving), min(edge.stamps[-1] for edge in moving)
        return stamps[(stamps >= first) & (stamps <= last)]

    def above(self, frame: str) -> Sequence[str]:
        """Return the frames from `frame` up to the root, both included."""
        way, circle = climb(frame, self._parent.get)
        if circle is not None:
            names = " -> ".join([*way[way.index(circle) :], circle][:_NAMED])
            raise LogError(f"the tf tree runs in a circle: {names}")
        return way

    def at(self, a: str, b: str, stamps: Floats) -> tuple[Floats, Bools]:
        """Return the interpolated a_T_b (Q, 4, 4) at timestamps (Q,), s, and a mask (Q,), True where the pose is known."""
        up, down = self._ways(a, b)
        top_T_a, known_a = self._down(up, stamps)
        top_T_b, known_b = self._down(down, stamps)
        return inverse(top_T_a) @ top_T_b, known_a & known_b

    def _down(self, way: Sequence[str], stamps: Floats) -> tuple[Floats, Bools]:
        pose = np.broadcast_to(np.eye(4), (len(stamps), 4, 4))
        known = np.ones(len(stamps), dtype=bool)
        for child in way:
            edge = self._edge(child)
            if edge.still:
                pose = edge.poses @ pose
            else:
                step, valid = interpolate(edge.stamps, edge.poses, stamps, MAX_GAP)
                pose, known = step @ pose, known & valid
        return pose, known

    def _ways(self, a: str, b: str) -> tuple[Sequence[str], Sequence[str]]:
        """Return the frames from a up to the first common ancestor of a and b, and those from b. Both lack the ancestor."""
        ways = part(self.above(a), self.above(b))
        if ways is None:
            raise LogError(
                f"tf does not connect {a!r} and {b!r}: {self._part(a)}; {self._part(b)}",
                hint="record /tf_static, or give the pose of the camera in --camera-info FILE: base_T_camera with "
                "translation and rotation_xyzw",
            )
        return ways

    def _part(self, frame: str) -> str:
        if frame not in self.frames:
            return f"{frame!r} is in no transform"
        near: dict[str, list[str]] = {}
        for child, parent in self._parent.items():
            near.setdefault(child, []).append(parent)
            near.setdefault(parent, []).append(child)
        found, edge = {frame}, [frame]
        while edge:
            edge = [other for name in edge for other in near[name] if other not in found]
            found.update(edge)
        others = sorted(found - {frame})
        more = f" and {len(others) - _NAMED} more" if len(others) > _NAMED else ""
        return f"{frame!r} is connected only to {', '.join(others[:_NAMED])}{more}"

    def _edge(self, child: str) -> _Edge:
        if child in self._edges:
            return self._edges[child]
        parent = self._parent[child]
        if others := sorted(self._parents[child].keys() - {parent}):
            self._ledger.warn(f"tf: {child} has several parents, {parent} is taken, not {', '.join(others)}")
        what = f"transform {parent} -> {child}"
        moving, static = self._rows.moving.get((parent, child)), self._rows.static.get((parent, child))
        stamps, poses = (moving or static or PoseRows()).checked(what, self._ledger)
        if not len(stamps):
            raise LogError(f"no usable {what} in tf")
        order = np.argsort(stamps, kind="stable")
        stamps, poses = stamps[order], poses[order]
        last = np.concatenate([np.diff(stamps) > 0, [True]])
        stamps, poses = stamps[last], poses[last]
        if unchanged(poses, poses[0]):
            stamps, poses = stamps[:1], poses[:1]
        return self._edges.setdefault(child, _Edge(parent, stamps, poses))
