"""The data that travels down the line: arrays in frozen dataclasses, validated where they are made.

Frames follow REP 103/105: `map`, `odom`, `base` (x forward, y left, z up), `camera` (optical: x right, y down, z
forward). `a_T_b` is the pose of b in a: it takes b coordinates to a coordinates. SI units, radians, seconds.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from objslam.core.arrays import Bools, Floats, Ints
from objslam.core.camera import Camera


def _need(condition: bool, message: str) -> None:
    if not condition:
        raise ValueError(message)


@dataclass(frozen=True)
class Trajectory:
    """Poses of one frame in another over time.

    stamps: (N,) s, finite, strictly increasing. poses: (N, 4, 4) homogeneous, finite. ValueError otherwise.
    """

    stamps: Floats
    poses: Floats

    def __post_init__(self) -> None:
        n = len(self.stamps)
        _need(self.stamps.shape == (n,) and self.poses.shape == (n, 4, 4), "a trajectory needs (N,) stamps, (N,4,4) poses")
        _need(bool(np.isfinite(self.stamps).all() and np.isfinite(self.poses).all()), "a trajectory has values not finite")
        _need(bool((np.diff(self.stamps) > 0).all()), "the stamps of a trajectory must increase")

    def __len__(self) -> int:
        return len(self.stamps)


@dataclass(frozen=True)
class Detections:
    """All boxes of one camera, struct of arrays; frames without a box are kept (they say what was not seen).

    frame_stamps: (F,) s, strictly increasing. frame: (M,) index into frame_stamps, non-decreasing. boxes: (M, 4)
    x1, y1, x2, y2 in px of the raw (distorted) image. label: (M,) index into label_names. scores: (M,) in [0, 1].
    depths: (M,) z along the optical axis, m, NaN where unknown. track_ids: (M,) -1 where unknown. whole: a box that the
    image cuts off is never among them (fiducials are found by all their corners), so that centres hold up to the edge.
    """

    frame_stamps: Floats
    frame: Ints
    boxes: Floats
    label: Ints
    scores: Floats
    depths: Floats
    track_ids: Ints
    label_names: tuple[str, ...]
    whole: bool = False

    def __post_init__(self) -> None:
        m = len(self.frame)
        _need(self.boxes.shape == (m, 4), "boxes must be (M, 4)")
        for name in ("frame", "label", "scores", "depths", "track_ids"):
            _need(getattr(self, name).shape == (m,), f"{name} must be (M,) like the boxes")
        _need(bool((np.diff(self.frame_stamps) > 0).all()), "the stamps of the frames must increase")
        _need(bool((np.diff(self.frame) >= 0).all()), "boxes must come in the order of their frames")
        if m:
            _need(0 <= int(self.frame.min()) and int(self.frame.max()) < len(self.frame_stamps), "frame out of range")
            _need(0 <= int(self.label.min()) and int(self.label.max()) < len(self.label_names), "label out of range")

    def __len__(self) -> int:
        return len(self.frame)

    @property
    def stamps(self) -> Floats:
        """(M,) the stamp of each box's frame, s."""
        return self.frame_stamps[self.frame]

    def take(self, boxes: Bools | Ints) -> Self:
        """The same frames with a selection of the boxes (mask or increasing indices)."""
        values: dict[str, Any] = {f.name: getattr(self, f.name) for f in fields(self)}
        for name in ("frame", "boxes", "label", "scores", "depths", "track_ids"):
            values[name] = values[name][boxes]
        return type(self)(**values)


@dataclass(frozen=True)
class Images:
    """Image files of one stream: stamps (N,) s, strictly increasing; paths, one each."""

    stamps: Floats
    paths: tuple[Path, ...]

    def __post_init__(self) -> None:
        _need(self.stamps.shape == (len(self.paths),), "one stamp an image")
        _need(bool((np.diff(self.stamps) > 0).all()), "the stamps of images must increase")


@dataclass(frozen=True)
class CameraLog:
    """What one camera brings: its calibration, and any of boxes, images, depth images and a moving mount.

    mount: base_T_camera over time (a camera on an arm); None where the camera's own base_T_camera holds throughout.
    """

    camera: Camera
    detections: Detections | None = None
    rgb: Images | None = None
    depth: Images | None = None
    mount: Trajectory | None = None


@dataclass(frozen=True)
class TruthObject:
    """One object of the ground truth: id, label, position (3,) in map, m."""

    id: int
    label: str
    position: Floats


@dataclass(frozen=True)
class Truth:
    """Ground truth for evaluation: objects, and map_T_base where known."""

    objects: tuple[TruthObject, ...] = ()
    trajectory: Trajectory | None = None


@dataclass(frozen=True)
class Log:
    """A robot's log: odometry is odom_T_base, localization is map_T_base; at least one of the two is there.

    path: the recording that it was read from, absolute; None where it was not.
    """

    name: str
    cameras: tuple[CameraLog, ...]
    odometry: Trajectory | None = None
    localization: Trajectory | None = None
    truth: Truth | None = None
    path: Path | None = None


@dataclass(frozen=True)
class Keyframes:
    """Camera frames with a pose, in the order of time (any camera), before estimation.

    stamps: (K,) s, non-decreasing. camera: (K,) index into log.cameras. frame: (K,) index into that camera's
    detections.frame_stamps. base_T_camera: (K, 4, 4). map_T_base: (K, 4, 4), the path to start from (localisation, else
    odometry). localized_every: how many keyframes share one absolute pose measurement (>= 1; they are interpolated), or 0
    when map_T_base is odometry. odom_T_base: (K, 4, 4) poses in a frame that starts with the odometry, None without it;
    drift: (K, 6, 6), the covariance that the odometry has gathered by then, as a sum in that same frame. stretch: (K,) the
    number of the odometry's stretch without a gap, -1 where there is none, whose odom_T_base and drift tell nothing; None
    where all are on one.
    """

    stamps: Floats
    camera: Ints
    frame: Ints
    base_T_camera: Floats
    map_T_base: Floats
    localized_every: float = 0.0
    odom_T_base: Floats | None = None
    drift: Floats | None = None
    stretch: Ints | None = None

    def __len__(self) -> int:
        return len(self.stamps)

    @property
    def map_T_camera(self) -> Floats:
        """(K, 4, 4) camera poses in map."""
        return self.map_T_base @ self.base_T_camera

    @property
    def measured(self) -> Bools:
        """(K-1,) whether the odometry measured the motion between two consecutive keyframes.

        Across a gap of it the robot may have been moved, and the odometry begun elsewhere. Without a localisation nothing
        else tells, and its word counts there, too.
        """
        steps = max(len(self) - 1, 0)
        if self.odom_T_base is None:
            return np.zeros(steps, dtype=bool)
        if self.stretch is None or not self.localized_every:
            return np.ones(steps, dtype=bool)
        return (self.stretch[1:] == self.stretch[:-1]) & (self.stretch[1:] >= 0)

    def take(self, keyframes: Bools | Ints) -> Self:
        """A selection of the keyframes (mask or increasing indices)."""
        values: dict[str, Any] = {}
        for f in fields(self):
            value = getattr(self, f.name)
            values[f.name] = value[keyframes] if isinstance(value, np.ndarray) else value
        return type(self)(**values)


@dataclass(frozen=True)
class Rays:
    """Bearing rays, one a box: where each box's undistorted centre points from its keyframe.

    keyframe: (R,) index into Keyframes, non-decreasing. direction: (R, 3) unit, camera frame. sigma: (R,) rad, one standard
    deviation of the angle along each of the two axes across the ray. range: (R,) m along the ray, NaN where unknown;
    range_sigma: (R,) m. label: (R,) index into label_names. score: (R,). box: (R, 4) raw px. track_id: (R,) -1 if unknown.
    """

    keyframe: Ints
    direction: Floats
    sigma: Floats
    range: Floats
    range_sigma: Floats
    label: Ints
    score: Floats
    box: Floats
    track_id: Ints
    label_names: tuple[str, ...]

    def __len__(self) -> int:
        return len(self.keyframe)

    def in_map(self, map_T_camera: Floats) -> tuple[Floats, Floats]:
        """Origins (R, 3) and unit directions (R, 3) in map for camera poses (K, 4, 4)."""
        poses = map_T_camera[self.keyframe]
        return poses[:, :3, 3], np.einsum("rij,rj->ri", poses[:, :3, :3], self.direction)

    def take(self, rays: Bools | Ints) -> Self:
        """A selection of the rays (mask or increasing indices)."""
        values: dict[str, Any] = {f.name: getattr(self, f.name) for f in fields(self)}
        selected: dict[str, Any] = {k: v[rays] if isinstance(v, np.ndarray) else v for k, v in values.items()}
        return type(self)(**selected)


@dataclass(frozen=True)
class Association:
    """Which ray belongs to which object: object (R,) index or -1; label: (N,) index into the rays' label_names.

    label_weights: (N, L) share of each label in an object's boxes. existence: (N,) probability that there is such an object.
    Both None where nobody asked.
    """

    object: Ints
    label: Ints
    label_weights: Floats | None = None
    existence: Floats | None = None

    @property
    def count(self) -> int:
        """Number of objects, N."""
        return len(self.label)


@dataclass(frozen=True)
class Surface:
    """A triangle mesh in map: vertices (V, 3) m and their normals (V, 3), float32; colours (V, 3) uint8 RGB, None where
    unknown; triangles (T, 3) int32, indices of vertices."""

    vertices: NDArray[np.float32]
    normals: NDArray[np.float32]
    colours: NDArray[np.uint8] | None
    triangles: NDArray[np.int32]


def label_table(names: Sequence[str]) -> tuple[tuple[str, ...], Ints]:
    """Distinct names in sorted order, and each name's index (len(names),) into them."""
    table = tuple(sorted(set(names)))
    index = {name: i for i, name in enumerate(table)}
    return table, np.array([index[name] for name in names], dtype=np.int64)


MAX_BOXES = 10_000
"""The most boxes of a frame; one with more is refused, for no detector finds them and association would take too long."""
