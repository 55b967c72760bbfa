"""A buffer of the transforms on /tf and /tf_static of a live robot. It keeps at least the last 10 s, as tf2 does."""

from bisect import bisect_left
from collections import Counter
from collections.abc import KeysView, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from objslam.core.arrays import Floats
from objslam.core.geometry import interpolate, inverse
from objslam.ros.messages.poses import one_pose
from objslam.ros.tf.frames import MAX_GAP, MAX_TRANSFORMS, climb, is_base, link, part, unchanged

_MAX_KEPT = 10_000
"""The largest number of buffered transforms of a child frame. It is enough for 10 s at 1 kHz. A larger number takes more
memory."""


class UnknownTransform(LookupError):
    """The error for a transform that is unknown at the requested time. later: whether a later message may supply it."""

    def __init__(self, message: str, later: bool) -> None:
        super().__init__(message)
        self.later = later


@dataclass
class _Edge:
    """The poses parent_T_child of a child frame at increasing timestamps, s.

    static: whether the poses come from /tf_static. still: whether the pose has never changed.
    """

    parent: str
    static: bool
    stamps: list[float] = field(default_factory=list)
    poses: list[Floats] = field(default_factory=list)
    still: bool = True

    def add(self, stamp: float, pose: Floats) -> bool:
        """Add a pose at a timestamp, s, and return True. If the pose is older than the newest pose, only return False.

        If the pose is older by more than `MAX_GAP` s, the clock was set back. In this case, the older poses are removed, and
        the pose is added. A pose with the newest timestamp replaces the newest pose.
        """
        if self.stamps and stamp < self.stamps[-1] - MAX_GAP:
            self.stamps.clear()
            self.poses.clear()
        if self.stamps and stamp <= self.stamps[-1]:
            if stamp == self.stamps[-1]:
                self.poses[-1] = pose
            return stamp == self.stamps[-1]
        self.still = self.still and (not self.poses or unchanged(pose, self.poses[-1]))
        self.stamps.append(stamp)
        self.poses.append(pose)
        if len(self.stamps) % 256 == 0:
            old = max(bisect_left(self.stamps, stamp - MAX_GAP), len(self.stamps) - _MAX_KEPT)
            del self.stamps[:old], self.poses[:old]
        return True

    def at(self, stamp: float) -> Floats:
        """Return the interpolated pose at a timestamp, s. A pose that has never changed is known at all times.

        Raises UnknownTransform if the timestamp is outside of the buffered times, or in a gap longer than `MAX_GAP` s.
        """
        if self.still:
            return self.poses[-1]
        after = bisect_left(self.stamps, stamp)
        if after == len(self.stamps):
            raise UnknownTransform("is not known yet", later=True)
        if self.stamps[after] == stamp:
            return self.poses[after]
        if after == 0:
            raise UnknownTransform("is no longer known", later=False)
        near = slice(after - 1, after + 1)
        pose, valid = interpolate(np.array(self.stamps[near]), np.array(self.poses[near]), np.array([stamp]), MAX_GAP)
        if not valid[0]:
            raise UnknownTransform("is not known", later=False)
        return np.asarray(pose[0])


class TfBuffer:
    """The latest transforms of all frames. A pose a_T_b transforms b coordinates to a coordinates.

    A moving frame gets a new parent only `MAX_GAP` s after the last transform to its old parent. A static transform never
    replaces a moving transform.
    """

    def __init__(self) -> None:
        self._edges: dict[str, _Edge] = {}
        self._names: Counter[str] = Counter()  # How many transforms each frame is in.
        self._bases: set[str] = set()

    def add(self, transform: Any, received: float, static: bool) -> str:
        """Add a geometry_msgs/TransformStamped and return its child frame. Raises ValueError if the transform is refused.

        received: the arrival time, s. static: whether the transform came on /tf_static.
        """
        parent, child = link(transform)
        pose = one_pose(transform.transform.translation, transform.transform.rotation)
        if pose is None:
            raise ValueError("transform whose pose is invalid (not finite, too far away, or a zero quaternion)")
        time = transform.header.stamp
        stamp = time.sec + time.nanosec * 1e-9 or received  # The arrival time replaces an unset timestamp.
        edge = self._edges.get(child)
        if edge is None and len(self._edges) >= MAX_TRANSFORMS:
            raise ValueError(f"transform beyond the first {MAX_TRANSFORMS} frames")
        if edge is not None and not edge.static:
            if static:
                raise ValueError("static transform of a frame that also has a moving one")
            if edge.parent != parent and abs(stamp - edge.stamps[-1]) < MAX_GAP:
                raise ValueError("transform of a frame that has another parent")
        if edge is None or edge.static or edge.parent != parent:  # Only the newest static transform counts.
            self._count(child, parent, None if edge is None else edge.parent)
            edge = self._edges[child] = _Edge(parent, static)
        if not edge.add(stamp, pose):
            raise ValueError("transform that is older than the last")
        return child

    @property
    def frames(self) -> KeysView[str]:
        """The names of all frames."""
        return self._names.keys()

    def likely_bases(self, moved: str) -> set[str]:
        """Return the frames among which `find_base` finds the base. moved: the child frame of the odometry."""
        return self._bases | {moved} if moved in self._names else set(self._bases)

    def _count(self, child: str, parent: str, old: str | None) -> None:
        """Count the frames of a new transform. old: the parent in the transform that it replaces, or None."""
        self._names.update((parent,) if old is not None else (parent, child))
        if old is not None:
            self._names[old] -= 1
            if not self._names[old]:
                del self._names[old]
                self._bases.discard(old)
        self._bases.update(frame for frame in (parent, child) if is_base(frame))

    def above(self, frame: str) -> Sequence[str]:
        """Return the frames from `frame` up to the root, both included. Raises UnknownTransform if they form a cycle."""
        way, circle = climb(frame, lambda child: self._edges[child].parent if child in self._edges else None)
        if circle is not None:
            raise UnknownTransform(f"tf runs in a circle at {circle}", later=True)
        return way

    def _between(self, a: str, b: str) -> tuple[Sequence[str], Sequence[str]]:
        """Return the frames from a up to the first common ancestor of a and b, and those from b. Both lack the ancestor."""
        ways = part(self.above(a), self.above(b))
        if ways is None:
            raise UnknownTransform(f"tf does not connect {a} and {b}", later=True)
        return ways

    def at(self, a: str, b: str, stamp: float) -> Floats:
        """Return the interpolated a_T_b (4, 4) at a timestamp, s. Raises UnknownTransform if it is unknown."""
        up, down = self._between(a, b)
        top_T_a, top_T_b = self._down(up, stamp), self._down(down, stamp)
        return np.asarray(inverse(top_T_a) @ top_T_b) if up else top_T_b

    def newest(self, a: str, b: str) -> float | None:
        """Return the newest timestamp, s, at which all transforms from a to b are known. Return None if all are static."""
        moving = [edge.stamps[-1] for way in self._between(a, b) for child in way if not (edge := self._edges[child]).static]
        return min(moving, default=None)

    def _down(self, way: Sequence[str], stamp: float) -> Floats:
        pose = np.eye(4)
        for child in way:
            try:
                pose = self._edges[child].at(stamp) @ pose
            except UnknownTransform as unknown:
                raise UnknownTransform(f"tf {self._edges[child].parent} -> {child} {unknown}", unknown.later) from None
        return pose
