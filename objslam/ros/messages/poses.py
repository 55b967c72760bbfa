"""Columns of times and poses, gathered message by message, made into checked arrays."""

from __future__ import annotations

from array import array
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from objslam.core.arrays import Bools, Floats, Ints
from objslam.core.diagnostics import Ledger
from objslam.core.geometry import pose_from_quaternion

_MAX_VALUES = np.array([1e9] * 3 + [1e3] * 4)
"""The largest x, y, z (m) and qx, qy, qz, qw of a pose; above them a message is taken for damaged."""

_SHORT = 1e-6  # The length of a quaternion, which should be 1, at and below which it is taken for zero.


@dataclass
class PoseRows:
    """Poses of one frame in another as they came: stamps and times of recording (ns); x, y, z, qx, qy, qz, qw of each."""

    stamps: array[int] = field(default_factory=lambda: array("q"))
    logged: array[int] = field(default_factory=lambda: array("q"))
    values: array[float] = field(default_factory=lambda: array("d"))

    def add(self, stamp: int, logged: int, place: Any, turn: Any) -> None:
        """Add a position (or translation) and an orientation message."""
        self.stamps.append(stamp)
        self.logged.append(logged)
        self.values.extend((place.x, place.y, place.z, turn.x, turn.y, turn.z, turn.w))

    def __len__(self) -> int:
        return len(self.stamps)

    def checked(self, what: str, ledger: Ledger) -> tuple[Floats, Floats]:
        """Stamps (N,), s, in the order they came, and poses (N, 4, 4); those that are no poses are dropped and counted."""
        values = np.frombuffer(self.values).reshape(-1, 7)
        good = _are_poses(values)
        stamps = choose_times(self.stamps, self.logged) / 1e9
        where = None if good.all() else f"stamp {stamps[~good][0]:.3f}"
        ledger.drop(f"{what} whose pose is none (not finite, or a zero quaternion)", int((~good).sum()), where)
        return stamps[good], pose_from_quaternion(values[good, :3], values[good, 3:])


def one_pose(place: Any, turn: Any) -> Floats | None:
    """The pose (4, 4) of a position (or translation) and an orientation message, None where they are no pose."""
    values = np.array([[place.x, place.y, place.z, turn.x, turn.y, turn.z, turn.w]], dtype=np.float64)
    return pose_from_quaternion(values[:, :3], values[:, 3:])[0] if _are_poses(values)[0] else None


def _are_poses(values: Floats) -> Bools:
    """Which rows of x, y, z, qx, qy, qz, qw (N, 7) are poses."""
    good = np.asarray((np.abs(values) < _MAX_VALUES).all(axis=1))
    return np.asarray(good & (np.linalg.norm(np.where(good[:, None], values[:, 3:], 0.0), axis=1) > _SHORT))


def choose_times(stamps: array[int], logged: array[int]) -> Ints:
    """(N,) ns: the header's stamps; the times of recording where all stamps are zero (nobody has set them)."""
    times = np.frombuffer(stamps, dtype=np.int64)
    return times if times.any() else np.frombuffer(logged, dtype=np.int64)
