"""Columns of times and poses, gathered message by message, made into checked arrays."""

from __future__ import annotations

from array import array
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from objslam.geometry import pose_from_quaternion
from objslam.ledger import Ledger
from objslam.types import Floats, Ints

_FAR, _LONG, _SHORT = 1e9, 1e3, 1e-6  # m; the length of a quaternion, which should be 1


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
        with np.errstate(invalid="ignore"):
            good = np.asarray((np.abs(values) < [_FAR] * 3 + [_LONG] * 4).all(axis=1))
        good &= np.linalg.norm(np.where(good[:, None], values[:, 3:], 0.0), axis=1) > _SHORT
        stamps = choose_times(self.stamps, self.logged) / 1e9
        where = None if good.all() else f"stamp {stamps[~good][0]:.3f}"
        ledger.drop(f"{what} whose pose is none (not finite, or a zero quaternion)", int((~good).sum()), where)
        return stamps[good], pose_from_quaternion(values[good, :3], values[good, 3:])


def one_pose(place: Any, turn: Any) -> Floats | None:
    """The pose (4, 4) of a position (or translation) and an orientation message, None where they are no pose."""
    xyz, xyzw = np.array([[place.x, place.y, place.z]], dtype=np.float64), np.array([[turn.x, turn.y, turn.z, turn.w]])
    good = bool((np.abs(xyz) < _FAR).all() and (np.abs(xyzw) < _LONG).all()) and float(np.linalg.norm(xyzw)) > _SHORT
    return pose_from_quaternion(xyz, xyzw)[0] if good else None


def choose_times(stamps: array[int], logged: array[int]) -> Ints:
    """(N,) ns: the header's stamps; the times of recording where all stamps are zero (nobody has set them)."""
    times = np.frombuffer(stamps, dtype=np.int64)
    return times if times.any() else np.frombuffer(logged, dtype=np.int64)
