"""Coordinate frames by name, and what a recorded tf tree and a live tf buffer have in common."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Sequence
from typing import Any

import numpy as np

from objslam.core.arrays import Floats
from objslam.ros.bag.records import frame_name

MAX_TRANSFORMS = 10_000
"""The most transforms of one message, and the most frames, that are taken; chosen to bound the memory."""

MAX_GAP = 10.0  # The longest gap between two transforms that is bridged, s; what tf2 remembers by default.
_STILL = 1e-9  # The most that a number of a pose may change for a frame to stand still; far below what any sensor can tell.
BASES = ("base_footprint", "base_link")
"""The frames of a robot's base (REP 105), without namespaces; the first that there is counts."""

_WORLDS = {"map", "world"}


def _leaf(frame: str) -> str:
    """A frame's name without its namespace."""
    return frame.rpartition("/")[2]


def is_world(frame: str) -> bool:
    """Whether a frame stands still in the world (map, world, robot1/map), as odom does not."""
    return not _WORLDS.isdisjoint(re.split(r"[^a-z]+", _leaf(frame).lower()))


def find_odom(frames: Iterable[str]) -> str:
    """The first odom of some frames, "" where there is none."""
    return next((frame for frame in frames if _leaf(frame) == "odom"), "")


def find_world(frames: Iterable[str]) -> str:
    """The first of some frames that stands still in the world, "" where there is none."""
    return next((frame for frame in frames if is_world(frame)), "")


def find_base(frames: Iterable[str], given: str | None, moved: str) -> str:
    """The frame that is base: the one given, else what the odometry moved, else base_footprint or base_link."""
    if given is not None:
        return given.lstrip("/")
    known = set(frames)
    if moved in known:
        return moved
    named = [frame for frame in known if _leaf(frame) in BASES]
    return min(named, key=lambda frame: (BASES.index(_leaf(frame)), frame), default=moved or BASES[-1])


def link(transform: Any) -> tuple[str, str]:
    """Parent and child of a geometry_msgs/TransformStamped; ValueError says why they can be none."""
    parent, child = frame_name(transform.header.frame_id), frame_name(transform.child_frame_id)
    if not parent or not child or parent == child:
        raise ValueError("transform without a frame, or of a frame to itself")
    return parent, child


def climb(frame: str, parent_of: Callable[[str], str | None]) -> tuple[tuple[str, ...], str | None]:
    """A frame, its parent, and so on up to the root; and the frame where they run in a circle, None where they do not."""
    way, seen = [frame], {frame}
    while (parent := parent_of(way[-1])) is not None:
        if parent in seen:
            return tuple(way), parent
        way.append(parent)
        seen.add(parent)
    return tuple(way), None


def part(above_a: Sequence[str], above_b: Sequence[str]) -> tuple[Sequence[str], Sequence[str]] | None:
    """Two ways to the root up to, and without, the first frame of both; None where they have none in common."""
    both = set(above_b)
    common = next((frame for frame in above_a if frame in both), None)
    return None if common is None else (above_a[: above_a.index(common)], above_b[: above_b.index(common)])


def unchanged(poses: Floats, pose: Floats) -> bool:
    """Whether poses (..., 4, 4) are a pose (4, 4), to rounding."""
    return bool(np.abs(poses - pose).max() <= _STILL)
