"""Classify coordinate frames by name, and search the tree of frames."""

import re
from collections.abc import Callable, Iterable, Sequence
from typing import Any

import numpy as np

from objslam.core.arrays import Floats
from objslam.ros.bag.records import frame_name

MAX_TRANSFORMS = 10_000  # The limit of transforms per message and of frames. The limit bounds memory.
MAX_GAP = 10.0
"""The longest interpolated gap between two transforms, s. tf2 has the same default buffer length. A larger value bridges
longer gaps, with less exact poses."""
_STILL = 1e-9  # A pose is static if no element of its matrix changes by more. A larger value takes slow motion for rest.
BASES = ("base_footprint", "base_link")  # The base frames of a robot (REP 105) without namespaces, by priority.
_WORLDS = {"map", "world"}


def _leaf(frame: str) -> str:
    return frame.rpartition("/")[2]


def is_world(frame: str) -> bool:
    """Return whether the name of a frame says that it is fixed in the world, as map, world or robot1/map do. odom does
    not."""
    return not _WORLDS.isdisjoint(re.split(r"[^a-z]+", _leaf(frame).lower()))


def is_base(frame: str) -> bool:
    """Return whether the name of a frame says that it is the base of a robot, with any namespace."""
    return _leaf(frame) in BASES


def find_odom(frames: Iterable[str]) -> str:
    """Return the first odom frame, "" without one."""
    return next((frame for frame in frames if _leaf(frame) == "odom"), "")


def find_world(frames: Iterable[str]) -> str:
    """Return the first frame that is fixed in the world, "" without one."""
    return next((frame for frame in frames if is_world(frame)), "")


def find_base(frames: Iterable[str], given: str | None, moved: str) -> str:
    """Return the base frame: `given`, or if `given` is None, the first that fits.

    `moved`, the child frame of the odometry, fits if it is in `frames`. Next come base_footprint and base_link in `frames`,
    with any namespace. If nothing fits, the result is `moved`, or base_link if `moved` is empty.
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
    """Return the frames from a frame up to the root, and the first repeated frame if they form a cycle, else None.
    In a cycle, the list ends before the repeated frame."""
    way, seen = [frame], {frame}
    while (parent := parent_of(way[-1])) is not None:
        if parent in seen:
            return tuple(way), parent
        way.append(parent)
        seen.add(parent)
    return tuple(way), None


def part(above_a: Sequence[str], above_b: Sequence[str]) -> tuple[Sequence[str], Sequence[str]] | None:
    """Return two ways to the root, both cut before their first common frame. Return None if they have no common frame."""
    both = set(above_b)
    common = next((frame for frame in above_a if frame in both), None)
    return None if common is None else (above_a[: above_a.index(common)], above_b[: above_b.index(common)])


def unchanged(poses: Floats, pose: Floats) -> bool:
    """Return whether the poses (..., 4, 4) equal a pose (4, 4) except for rounding."""
    return bool(np.abs(poses - pose).max() <= _STILL)
