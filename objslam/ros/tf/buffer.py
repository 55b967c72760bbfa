"""The frames of a running robot: transforms of /tf and /tf_static as they come, kept for as long as tf2 keeps them."""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from objslam.core.arrays import Floats
from objslam.core.geometry import interpolate, inverse
from objslam.ros.messages.poses import one_pose
from objslam.ros.tf.frames import MAX_GAP, MAX_TRANSFORMS, climb, link, part, unchanged

_MAX_KEPT = 10_000  # The most transforms of one pair of frames that are kept; chosen for 10 s at 1 kHz.


class UnknownTransform(LookupError):
    """A transform is not known at that time; `later` tells whether one that is still to come may make it known."""

    def __init__(self, message: str, later: bool) -> None:
        super().__init__(message)
        self.later = later


@dataclass
class _Edge:
    """parent_T_child: one pose while it has never changed, else at stamps, s, increasing."""

    parent: str
    static: bool
    stamps: list[float] = field(default_factory=list)
    poses: list[Floats] = field(default_factory=list)
    still: bool = True

    def add(self, stamp: float, pose: Floats) -> bool:
        """Add a pose; False where it comes too late to count. A clock that was set back begins again."""
        if self.stamps and stamp < self.stamps[-1] - MAX_GAP:
            self.stamps.clear()
            self.poses.clear()
        if self.stamps and stamp < self.stamps[-1]:
            return False
        if self.stamps and stamp == self.stamps[-1]:
            self.poses[-1] = pose
            return True
        self.still = self.still and (not self.poses or unchanged(pose, self.poses[-1]))
        self.stamps.append(stamp)
        self.poses.append(pose)
        if len(self.stamps) % 256 == 0:
            old = max(bisect_left(self.stamps, stamp - MAX_GAP), len(self.stamps) - _MAX_KEPT)
            del self.stamps[:old], self.poses[:old]
        return True

    def at(self, stamp: float) -> Floats:
        """The pose at a stamp, interpolated; UnknownTransform outside of what is known."""
        if self.still:
            return self.poses[-1]
        after = bisect_left(self.stamps, stamp)
        if after == len(self.stamps):
            raise UnknownTransform("not yet", later=True)
        if self.stamps[after] == stamp:
            return self.poses[after]
        if after == 0:
            raise UnknownTransform("no longer known", later=False)
        near = slice(after - 1, after + 1)
        pose, valid = interpolate(np.array(self.stamps[near]), np.array(self.poses[near]), np.array([stamp]), MAX_GAP)
        if not valid[0]:
            raise UnknownTransform("not known", later=False)
        return np.asarray(pose[0])


class TfBuffer:
    """Transforms by child frame. Poses a_T_b take b coordinates to a coordinates.

    A frame that a second parent claims keeps its first for as long as that is heard (`MAX_GAP` s); a static transform never
    takes the place of one that moves.
    """

    def __init__(self) -> None:
        self._edges: dict[str, _Edge] = {}

    def add(self, transform: Any, received: float, static: bool) -> str:
        """Add a geometry_msgs/TransformStamped; its child frame. ValueError says why one cannot be used.

        received: s, stands in for a stamp that nobody has set.
        """
        parent, child = link(transform)
        pose = one_pose(transform.transform.translation, transform.transform.rotation)
        if pose is None:
            raise ValueError("transform that is no pose (not finite, or a zero quaternion)")
        time = transform.header.stamp
        stamp = time.sec + time.nanosec * 1e-9 or received
        edge = self._edges.get(child)
        if edge is None and len(self._edges) >= MAX_TRANSFORMS:
            raise ValueError(f"transform beyond the first {MAX_TRANSFORMS} frames")
        if edge is not None and not edge.static:
            if static:
                raise ValueError("static transform of a frame that also has a moving one")
            if edge.parent != parent and abs(stamp - edge.stamps[-1]) < MAX_GAP:
                raise ValueError("transform of a frame that has another parent")
        if edge is None or edge.static or edge.parent != parent:  # of static ones the newest alone counts
            edge = self._edges[child] = _Edge(parent, static)
        if not edge.add(stamp, pose):
            raise ValueError("transform that is older than the last")
        return child

    @property
    def frames(self) -> set[str]:
        """All frames."""
        return set(self._edges) | {edge.parent for edge in self._edges.values()}

    def above(self, frame: str) -> Sequence[str]:
        """A frame, its parent, and so on up to the root; UnknownTransform where they run in a circle."""
        way, circle = climb(frame, lambda child: self._edges[child].parent if child in self._edges else None)
        if circle is not None:
            raise UnknownTransform(f"tf runs in a circle at {circle}", later=True)
        return way

    def _between(self, a: str, b: str) -> tuple[Sequence[str], Sequence[str]]:
        """The frames from a and from b up to, and without, the first above both."""
        ways = part(self.above(a), self.above(b))
        if ways is None:
            raise UnknownTransform(f"tf does not connect {a} and {b}", later=True)
        return ways

    def at(self, a: str, b: str, stamp: float) -> Floats:
        """a_T_b (4, 4) at a stamp, s, each moving transform interpolated; UnknownTransform where it is not known."""
        up, down = self._between(a, b)
        top_T_a, top_T_b = self._down(up, stamp), self._down(down, stamp)
        return np.asarray(inverse(top_T_a) @ top_T_b) if up else top_T_b

    def newest(self, a: str, b: str) -> float | None:
        """The newest stamp, s, at which all transforms between a and b are known; None where all of them are static."""
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
