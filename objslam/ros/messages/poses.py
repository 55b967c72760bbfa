"""Collect poses and timestamps of messages and convert them to checked arrays."""

from __future__ import annotations

from array import array
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from objslam.core.arrays import Floats, Ints
from objslam.core.diagnostics import Ledger
from objslam.core.geometry import pose_from_quaternion
from objslam.core.validity import valid_pose_rows


@dataclass
class PoseRows:
    """Poses in the order of arrival. stamps: the header timestamps, ns. logged: the recording times, ns. values: the numbers
    x, y, z (m), qx, qy, qz, qw of one pose after the other."""

    stamps: array[int] = field(default_factory=lambda: array("q"))
    logged: array[int] = field(default_factory=lambda: array("q"))
    values: array[float] = field(default_factory=lambda: array("d"))

    def add(self, stamp: int, logged: int, place: Any, turn: Any) -> None:
        """Add a pose. stamp: its header timestamp, ns. logged: its recording time, ns. place: the message of its position or
        translation. turn: the message of its orientation."""
        self.stamps.append(stamp)
        self.logged.append(logged)
        self.values.extend((place.x, place.y, place.z, turn.x, turn.y, turn.z, turn.w))

    def __len__(self) -> int:
        return len(self.stamps)

    def checked(self, what: str, ledger: Ledger) -> tuple[Floats, Floats]:
        """Return the timestamps (N,), s, and the matrices (N, 4, 4) of the valid poses in the order of arrival.
        Invalid poses are counted as drops. what: the word for a pose in the reason of a drop."""
        values = np.frombuffer(self.values).reshape(-1, 7)
        good = valid_pose_rows(values)
        stamps = choose_times(self.stamps, self.logged) / 1e9
        where = None if good.all() else f"stamp {stamps[~good][0]:.3f}"
        ledger.drop(
            f"{what} whose pose is invalid (not finite, too far away, or a zero quaternion)", int((~good).sum()), where
        )
        return stamps[good], pose_from_quaternion(values[good, :3], values[good, 3:])


def one_pose(place: Any, turn: Any) -> Floats | None:
    """Return the pose (4, 4) of a position (or translation) message and an orientation message. Return None if the pose is
    invalid."""
    values = np.array([[place.x, place.y, place.z, turn.x, turn.y, turn.z, turn.w]], dtype=np.float64)
    return pose_from_quaternion(values[:, :3], values[:, 3:])[0] if valid_pose_rows(values)[0] else None


def choose_times(stamps: array[int], logged: array[int]) -> Ints:
    """Return the header timestamps (N,), ns. If all of them are unset (zero), return the recording times (N,), ns."""
    times = np.frombuffer(stamps, dtype=np.int64)
    return times if times.any() else np.frombuffer(logged, dtype=np.int64)
