"""Variables of the graph by their symbols: X(k) is the pose of a camera in map, L(j) is the position of object j.

In X(k), k is a keyframe. If images share a pose, k is a multiframe, and X(k) the pose of its first camera. Y(t) is the pose
of fiducial t. If the size of fiducial t is unknown, Z(t) (m) is the first value of half its diagonal minus the present
value.

A symbol is a letter and a number. A graph may also hold other variables, so variables are found by symbol, never by type.
"""

from dataclasses import dataclass, field
from typing import Any, Self

import gtsam
import numpy as np

from objslam.core.arrays import Floats, Ints
from objslam.core.geometry import make_pose

X0 = gtsam.symbol("x", 0)
"""The key of X(0). The key of X(k) is X0 + k."""
L0 = gtsam.symbol("l", 0)
"""The key of L(0). The key of L(j) is L0 + j."""
TAG0 = gtsam.symbol("y", 0)
"""The key of Y(0). The key of Y(t) is TAG0 + t. Keys of fiducials are above the keys of keyframes and landmarks, so that the
columns of a linear system begin with landmarks and poses."""
TAG_SIZE0 = gtsam.symbol("z", 0)
"""The key of Z(0). The key of Z(t) is TAG_SIZE0 + t."""
LETTER = 56
"""The number of bits of a key that hold the number of the symbol. The letter is in the bits above."""


def make_values(map_T_camera: Floats, positions: Floats, landmarks: Ints) -> gtsam.Values:
    """Return values with X(0) to X(K-1) at map_T_camera (K, 4, 4), and L(j) at positions[j] for each j in landmarks."""
    values = gtsam.Values()
    add_values(values, map_T_camera, positions, np.arange(len(map_T_camera)), landmarks)
    return values


def add_values(values: gtsam.Values, map_T_camera: Floats, positions: Floats, keyframes: Ints, landmarks: Ints) -> None:
    """Add X(k) at map_T_camera[k] for each k in keyframes, and L(j) at positions[j] for each j in landmarks, to values."""
    for k in keyframes.tolist():
        values.insert(X0 + k, gtsam.Pose3(map_T_camera[k]))
    for j in landmarks.tolist():
        values.insert(L0 + j, positions[j])


def read_poses(values: gtsam.Values) -> Floats:
    """Return the poses X (K, 4, 4) of the values, in the order of their numbers."""
    return keyframes_in(values)[1]


def keyframes_in(values: gtsam.Values) -> tuple[Ints, Floats]:
    """Return the numbers (K,) and the poses (K, 4, 4) of the variables X, in the order of their numbers."""
    keys = _keys(values, X0)
    flat = gtsam.utilities.extractPose3(values)
    if len(flat) != len(keys):  # some poses are not keyframes
        flat = gtsam.utilities.extractPose3(values.extract(keys.tolist()))
    return keys - X0, make_pose(flat[:, :9].reshape(-1, 3, 3), flat[:, 9:])


def landmarks_in(values: gtsam.Values) -> tuple[Ints, Floats]:
    """Return the numbers (n,) and the points (n, 3) of the variables L, in the order of their numbers."""
    keys = _keys(values, L0)
    return keys - L0, _points(values, keys)


def with_points(positions: Floats, landmarks: Ints, values: gtsam.Values) -> Floats:
    """Return a copy of positions (N, 3) in which the landmarks (n,) have their points from the values."""
    placed = positions.copy()
    placed[landmarks] = _points(values, L0 + landmarks)
    return placed


@dataclass
class Variables:
    """The estimate of a growing graph: poses X (4, 4) and points L (3,) by number, other variables by key."""

    poses: dict[int, Floats] = field(default_factory=dict)
    points: dict[int, Floats] = field(default_factory=dict)
    others: dict[int, Any] = field(default_factory=dict)

    def copy(self) -> Self:
        """Return a copy with tables of its own. The arrays are shared."""
        return type(self)(dict(self.poses), dict(self.points), dict(self.others))

    def insert(self, keys: list[int], values: gtsam.Values) -> None:
        """Insert the variables of these keys into the values."""
        for key in keys:
            letter = key >> LETTER
            if letter == X0 >> LETTER:
                values.insert(key, gtsam.Pose3(self.poses[key - X0]))
            else:
                values.insert(key, self.points[key - L0] if letter == L0 >> LETTER else self.others[key])

    def values(self) -> gtsam.Values:
        """Return all variables as values."""
        values = gtsam.Values()
        self.insert([*(X0 + k for k in self.poses), *(L0 + j for j in self.points), *self.others], values)
        return values

    def read(self, values: gtsam.Values) -> None:
        """Set the variables from the values. A variable without a value in them does not change. Values of other variables
        are ignored."""
        poses, points = (
            dict(zip(number.tolist(), found, strict=True)) for number, found in (keyframes_in(values), landmarks_in(values))
        )
        self.poses = {k: poses.get(k, pose) for k, pose in self.poses.items()}
        self.points = {j: points.get(j, point) for j, point in self.points.items()}
        self.others = {key: _at(values, key, old) if values.exists(key) else old for key, old in self.others.items()}


def _keys(values: gtsam.Values, first: int) -> Ints:
    """Return the keys (n,) that have the same letter as the key `first`, in ascending order."""
    keys = np.array(values.keys(), dtype=np.int64)
    return keys[keys >> LETTER == first >> LETTER]


def _points(values: gtsam.Values, keys: Ints) -> Floats:
    return np.array([values.atPoint3(key) for key in keys.tolist()]).reshape(-1, 3)


def _at(values: gtsam.Values, key: int, like: object) -> object:
    """Return the variable with this key: a pose if `like` is a pose, else a point."""
    return values.atPoint3(key) if isinstance(like, np.ndarray) else getattr(values, f"at{type(like).__name__}")(key)
