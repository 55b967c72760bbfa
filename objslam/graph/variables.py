"""Variables by their symbols: X(k) is keyframe k's camera in map (Pose3), L(j) is object j (Point3).

A symbol is a letter and a number. Others may stand beside these two in a graph: what is read here is found by its symbol,
never by its type.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Self

import gtsam
import numpy as np

from objslam.core.arrays import Floats, Ints

X0 = gtsam.symbol("x", 0)
"""The key of X(0); that of X(k) is X0 + k."""
L0 = gtsam.symbol("l", 0)
"""The key of L(0); that of L(j) is L0 + j."""
LETTER = 56
"""The bits of a key below its letter, which hold the number."""


def make_values(map_T_camera: Floats, positions: Floats, landmarks: Ints) -> gtsam.Values:
    """Values with X(0..K-1) at map_T_camera (K, 4, 4), and L(j) at positions[j] for each j of landmarks."""
    values = gtsam.Values()
    for k, pose in enumerate(map_T_camera):
        values.insert(X0 + k, gtsam.Pose3(pose))
    for j in landmarks.tolist():
        values.insert(L0 + j, positions[j])
    return values


def read_poses(values: gtsam.Values) -> Floats:
    """(K, 4, 4) the poses X of the values in the order of their numbers, made orthonormal to rounding."""
    return _read(values)[1]


def read_points(values: gtsam.Values) -> Floats:
    """(n, 3) the points L of the values in the order of their numbers."""
    return _points(values, _keys(values, L0))


def with_points(positions: Floats, landmarks: Ints, values: gtsam.Values) -> Floats:
    """The positions (N, 3) with those of the landmarks (n,) as the values have them."""
    placed = positions.copy()
    placed[landmarks] = _points(values, L0 + landmarks)
    return placed


@dataclass
class Variables:
    """The estimate of a growing graph: poses X (4, 4) and points L (3,) by their numbers, any others by their keys."""

    poses: dict[int, Floats] = field(default_factory=dict)
    points: dict[int, Floats] = field(default_factory=dict)
    others: dict[int, Any] = field(default_factory=dict)

    def copy(self) -> Self:
        """The same estimate, in tables of its own."""
        return type(self)(dict(self.poses), dict(self.points), dict(self.others))

    def insert(self, keys: list[int], values: gtsam.Values) -> None:
        """Put some of the variables into values."""
        for key in keys:
            letter = key >> LETTER
            if letter == X0 >> LETTER:
                values.insert(key, gtsam.Pose3(self.poses[key - X0]))
            else:
                values.insert(key, self.points[key - L0] if letter == L0 >> LETTER else self.others[key])

    def values(self) -> gtsam.Values:
        """All of them."""
        values = gtsam.Values()
        self.insert([*(X0 + k for k in self.poses), *(L0 + j for j in self.points), *self.others], values)
        return values

    def read(self, values: gtsam.Values) -> None:
        """Take what the values have of these variables; they may lack some, and have some that were dropped."""
        keys, found = _read(values)
        poses = dict(zip((keys - X0).tolist(), found, strict=True))
        keys = _keys(values, L0)
        points = dict(zip((keys - L0).tolist(), _points(values, keys), strict=True))
        self.poses = {k: poses.get(k, pose) for k, pose in self.poses.items()}
        self.points = {j: points.get(j, point) for j, point in self.points.items()}
        self.others = {key: _at(values, key, old) if values.exists(key) else old for key, old in self.others.items()}


def _keys(values: gtsam.Values, first: int) -> Ints:
    """The keys (n,) of the variables with the letter of `first`, in their order."""
    keys = np.array(values.keys(), dtype=np.int64)
    return keys[keys >> LETTER == first >> LETTER]


def _read(values: gtsam.Values) -> tuple[Ints, Floats]:
    """The keys (K,) of the poses X, and the poses (K, 4, 4)."""
    keys = _keys(values, X0)
    flat = gtsam.utilities.extractPose3(values)
    if len(flat) != len(keys):  # other variables are poses, too
        flat = gtsam.utilities.extractPose3(values.extract(keys.tolist()))
    poses = np.tile(np.eye(4), (len(keys), 1, 1))
    poses[:, :3, :3] = flat[:, :9].reshape(-1, 3, 3)
    poses[:, :3, 3] = flat[:, 9:]
    return keys, poses


def _points(values: gtsam.Values, keys: Ints) -> Floats:
    return np.array([values.atPoint3(key) for key in keys.tolist()]).reshape(-1, 3)


def _at(values: gtsam.Values, key: int, like: object) -> object:
    """A variable of the type of another."""
    return values.atPoint3(key) if isinstance(like, np.ndarray) else getattr(values, f"at{type(like).__name__}")(key)
