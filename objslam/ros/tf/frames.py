"""Classify coordinate frames by name, and search the tree of frames."""

import re
from collections.abc import Callable, Iterable, Sequence
from typing import Any

import numpy as np

from objslam.core.arrays import Floats
from objslam.ros.bag.records import frame_name

MAX_TRANSFORMS = 10_000  # The largest number of transforms in a message, and of frames. The limit bounds memory.
MAX_GAP = 10.0
"""The longest gap between two transforms that interpolation bridges, s. It equals the default buffer length of tf2. A larger
value bridges longer gaps, with less exact poses."""
_STILL = 1e-9  # The largest change of a matrix element of a static pose. A larger value takes slow motion for rest.
BASES = ("base_footprint", "base_link")  # The base frames of a robot (REP 105) without namespaces, by priority.
_WORLDS = {"map", "world"}


def _leaf(frame: str) -> str:
    return frame.rpartition("/")[2]


def is_world(frame: str) -> bool:
    """Return whether the name of a frame says that the frame is fixed in the world. Examples are map, world and robot1/map.
    odom is not one."""
    return not _WORLDS.isdisjoint(re.split(r"[^a-z]+", _leaf(frame).lower()))


def is_base(frame: str) -> bool:
    """Return whether a frame has the name of a robot's base, with any namespace."""
    return _leaf(frame) in BASES


def find_odom(frames: Iterable[str]) -> str:
    """Return the first frame whose name is odom, with any namespace. Return "" if there is none."""
    return next((frame for frame in frames if _leaf(frame) == "odom"), "")


def find_world(frames: Iterable[str]) -> str:
    """Return the first frame that is fixed in the world by its name. Return "" if there is none."""
    return next((frame for frame in frames if is_world(frame)), "")


def find_base(frames: Iterable[str], given: str | None, moved: str) -> str:
    """Return the name of the base frame of the robot.

    frames: the known frames. given: the base frame that the user named, or None. moved: the child frame of the odometry, or
    "". The result is `given`, unless it is None. Else, the result is `moved` if it is in `frames`. Else, it is
    base_footprint or base_link in `frames`, with any namespace. Else, it is `moved`, or base_link if `moved` is empty.
    """
    if given is not None:
        return given.lstrip("/")
    known = set(frames)
    if moved in known:
        return moved
    named = [frame for frame in known if is_base(frame)]
    return min(named, key=lambda frame: (BASES.index(_leaf(frame)), frame), default=moved or BASES[-1])


def link(transform: Any) -> tuple[str, str]:
    """Return the parent and child frame of a geometry_msgs/TransformStamped. Raises ValueError if they are invalid."""
    parent, child = frame_name(transform.header.frame_id), frame_name(transform.child_frame_id)
    if not parent or not child or parent == child:
        raise ValueError("transform without a frame, or of a frame to itself")
    return parent, child


def climb(frame: str, parent_of: Callable[[str], str | None]) -> tuple[tuple[str, ...], str | None]:
    """Return the frames from `frame` up to the root, and None. If the frames form a cycle, return the frames before the
    first repetition, and the repeated frame. parent_of: a function that returns the parent of a frame, None for the root."""
    way, seen = [frame], {frame}
    while (parent := parent_of(way[-1])) is not None:
        if parent in seen:
            return tuple(way), parent
        way.append(parent)
        seen.add(parent)
    return tuple(way), None


def part(above_a: Sequence[str], above_b: Sequence[str]) -> tuple[Sequence[str], Sequence[str]] | None:
    """Return two ways to the root, both cut before the first common frame. Return None if they have no common frame.
    above_a, above_b: the frames from a and from b up to the root."""
    both = set(above_b)
    common = next((frame for frame in above_a if frame in both), None)
    return None if common is None else (above_a[: above_a.index(common)], above_b[: above_b.index(common)])


def unchanged(poses: Floats, pose: Floats) -> bool:
    """Return whether the poses (..., 4, 4) equal a pose (4, 4) except for rounding."""
    return bool(np.abs(poses - pose).max() <= _STILL)
