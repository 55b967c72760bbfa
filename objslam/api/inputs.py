"""The data classes for users: logs, detections and trajectories that are made from arrays. Their base classes are in
`core.types` and `core.trajectory`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Self

import numpy as np
from numpy.typing import ArrayLike

from objslam.api.array_input import as_boxes, as_poses, as_stamps, per_box
from objslam.api.camera import as_camera
from objslam.core import trajectory, types
from objslam.core.appearance.features import MAX_FEATURES, unit_vectors
from objslam.core.arrays import Floats32
from objslam.core.camera import Camera
from objslam.core.geometry import quaternion
from objslam.core.validity import box_rules, is_name, valid_depths
from objslam.io.tables import arrow_table, to_pandas

if TYPE_CHECKING:
    import pandas as pd
    import pyarrow as pa

_COLUMNS = ("stamp", "x", "y", "z", "qx", "qy", "qz", "qw")  # The columns of a table of poses, in s and m.


class Trajectory(trajectory.Trajectory):
    """Poses of one coordinate frame in another over time. stamps: (N,) s, increasing. poses: (N, 4, 4), with positions in
    m."""

    @classmethod
    def from_arrays(cls, stamps: ArrayLike, poses: ArrayLike) -> Self:
        """Return a trajectory from stamps (N,), s, and poses.

        poses: matrices (N, 4, 4), or rows (N, 3) of x, y, yaw, or rows (N, 7) of x, y, z, qx, qy, qz, qw, in m and rad.
        ValueError names the first wrong row.
        """
        times, rows = as_stamps(stamps), as_poses(poses)
        if len(times) != len(rows):
            raise ValueError(f"a trajectory needs one pose for each stamp, got {len(rows)} for {len(times)}")
        return cls(times, rows)

    def to_arrow(self) -> pa.Table:
        """Return the poses as a pyarrow table with the columns stamp (s), x, y, z (m), qx, qy, qz, qw."""
        turns = quaternion(self.poses) if len(self) else np.zeros((0, 4))
        values = np.column_stack([self.stamps, self.poses[:, :3, 3], turns])
        return arrow_table(dict(zip(_COLUMNS, values.T.copy(), strict=True)))

    def to_pandas(self) -> pd.DataFrame:
        """Return the poses as a pandas data frame. ObjslamError if pandas is not installed."""
        return to_pandas(self.to_arrow())

    def __repr__(self) -> str:
        if not len(self):
            return "Trajectory of 0 poses"
        way = float(np.linalg.norm(np.diff(self.poses[:, :3, 3], axis=0), axis=1).sum())
        return f"Trajectory of {len(self)} poses over {self.stamps[-1] - self.stamps[0]:.1f} s and {way:.1f} m"


class Detections(types.Detections):
    """All boxes of one camera."""

    @classmethod
    def from_frames(
        cls,
        stamps: ArrayLike,
        boxes: Sequence[ArrayLike],
        labels: Sequence[Sequence[str | int]],
        scores: Sequence[ArrayLike] | None = None,
        *,
        depths: Sequence[ArrayLike] | None = None,
        track_ids: Sequence[ArrayLike] | None = None,
        features: Sequence[ArrayLike] | None = None,
        whole: bool = False,
    ) -> Self:
        """Return the detections of one camera. Each argument except `whole` has one entry for each of the F frames. A frame
        without a box has empty lists.

        stamps: (F,) s. boxes: for each frame (B, 4) x1, y1, x2, y2 in px of the raw image. labels: for each frame B names or
        integers. scores: for each frame (B,) in [0, 1], 1 by default. depths: for each frame (B,) z along the optical axis
        in m, NaN if unknown. track_ids: for each frame B integers, -1 if unknown. features: for each frame (B, D) appearance
        vectors, such as the embeddings of a network. D is at least 1. An unknown vector is a row of NaN. whole: whether the
        image's edge cuts off no box. ValueError names the wrong frame or argument.
        """
        frames = [as_boxes(one, f"frame {k}") for k, one in enumerate(boxes)]
        counts = [len(one) for one in frames]
        times = as_stamps(stamps)
        if len(frames) != len(times):
            raise ValueError(f"boxes needs one list for each stamp, got {len(frames)} for {len(times)}")
        if len(labels) != len(counts):
            raise ValueError(f"labels needs one list for each frame, got {len(labels)} for {len(counts)}")
        for k, (one, count) in enumerate(zip(labels, counts, strict=True)):
            if isinstance(one, str) or len(one) != count:
                got = repr(one) if isinstance(one, str) else len(one)
                raise ValueError(f"frame {k}: labels needs one list with one name for each of its {count} boxes, got {got}")
        if max(counts, default=0) > types.MAX_BOXES:
            raise ValueError(f"a frame has more than {types.MAX_BOXES} boxes")
        corners, score = np.concatenate([*frames, np.zeros((0, 4))]), per_box(scores, counts, 1.0, "scores")
        names, depth = [_name(label) for one in labels for label in one], per_box(depths, counts, np.nan, "depths")
        named = np.array([is_name(name) for name in names], dtype=bool)
        known = np.isnan(depth) | valid_depths(depth)
        frame = np.repeat(np.arange(len(frames)), counts)
        for good, reason in (*box_rules(corners, score, named), (known, "box with a depth that is not above zero")):
            if not good.all():
                raise ValueError(f"frame {frame[np.argmin(good)]}: {reason}")
        table, label = types.label_table(names)
        tracks = np.maximum(per_box(track_ids, counts, -1, "track_ids"), -1).astype(np.int64)
        given = None if features is None else _unit_features(features, counts)
        return cls(times, frame, corners, label, score, depth, tracks, table, whole, features=given)

    def __repr__(self) -> str:
        return f"Detections: {len(self)} boxes of {len(self.label_names)} labels in {len(self.frame_stamps)} frames"


class Log(types.Log):
    """The log of a robot: its cameras with their boxes or images, and its odometry, its localisation or both."""

    @classmethod
    def from_arrays(
        cls,
        cameras: Camera | Sequence[Camera],
        detections: types.Detections | Sequence[types.Detections],
        *,
        odometry: tuple[ArrayLike, ArrayLike] | trajectory.Trajectory | None = None,
        localization: tuple[ArrayLike, ArrayLike] | trajectory.Trajectory | None = None,
        name: str = "log",
    ) -> Self:
        """Return a log from cameras, detections and paths.

        cameras, detections: one camera and its detections, or two sequences of equal length. odometry: the poses
        odom_T_base. localization: the poses map_T_base. A log needs odometry, a localisation or both. Each is a
        `Trajectory`, or a pair of stamps and poses as for `Trajectory.from_arrays`. ValueError names what is wrong.
        """
        lenses = [as_camera(one) for one in ([cameras] if isinstance(cameras, Camera) else cameras)]
        boxes = [detections] if isinstance(detections, types.Detections) else list(detections)
        if len(lenses) != len(boxes):
            raise ValueError(f"each camera needs its detections, got {len(lenses)} cameras and {len(boxes)} detections")
        names = [one.name for one in lenses]
        if repeated := sorted({one for one in names if names.count(one) > 1}):
            raise ValueError(f"each camera needs a name of its own, got {', '.join(map(repr, repeated))} more than once")
        if odometry is None and localization is None:
            raise ValueError("a log needs odometry, localization or both")
        views = tuple(types.CameraLog(camera, found) for camera, found in zip(lenses, boxes, strict=True))
        return cls(name, views, _path(odometry, "odometry"), _path(localization, "localization"))

    def with_detections(self, detections: types.Detections | Mapping[str, types.Detections]) -> Self:
        """Return the log with the given detections in place of its own. detections: those of the only camera of the log, or
        a mapping from camera names to detections.

        ValueError if the given names differ from the names of the cameras.
        """
        names = [camera.camera.name for camera in self.cameras]
        found = {names[0]: detections} if isinstance(detections, types.Detections) and len(names) == 1 else detections
        if isinstance(found, types.Detections) or set(found) != set(names):
            raise ValueError(f"detections must be given by camera name, for exactly these cameras: {', '.join(names)}")
        return replace(self, cameras=tuple(replace(one, detections=found[one.camera.name]) for one in self.cameras))

    def __repr__(self) -> str:
        paths = [f"{name} of {len(path)} poses" for name, path in self._paths().items() if path is not None]
        cameras = [f"camera {c.camera.name}: {_content(c)}" for c in self.cameras]
        return f"Log {self.name!r}: {'; '.join([*paths, *cameras])}"

    def _paths(self) -> dict[str, trajectory.Trajectory | None]:
        return {"odometry": self.odometry, "localisation": self.localization}


def _name(label: str | int) -> str:
    """Return a label as text. An integer becomes its digits, as in detections.jsonl. Any other value is returned
    unchanged."""
    return str(int(label)) if isinstance(label, (int, np.integer)) and not isinstance(label, bool) else label  # type: ignore[return-value]


def _unit_features(features: Sequence[ArrayLike], counts: list[int]) -> Floats32:
    """Return the unit appearance vectors (M, D) of all M boxes. The row of a box without a vector is NaN. ValueError names
    the wrong frame.

    features: for each frame (B, D) the vectors of its boxes. counts: the number of boxes of each frame.
    """
    if len(features) != len(counts):
        raise ValueError(f"features needs one list for each frame, got {len(features)} for {len(counts)}")
    frames = [np.asarray(one, dtype=np.float64) for one in features]
    length = next((one.shape[1] for one in frames if one.ndim == 2), 1)
    for k, (one, count) in enumerate(zip(frames, counts, strict=True)):
        if one.shape != (count, length) and (count or one.size):
            raise ValueError(f"frame {k}: features are ({count}, {length}), got the shape {one.shape}")
    if not 0 < length <= MAX_FEATURES:
        raise ValueError(f"features have 1 to {MAX_FEATURES} numbers each, got {length}")
    values = np.concatenate([np.zeros((0, length)), *(one.reshape(-1, length) for one in frames)])
    units, good = unit_vectors(values)
    wrong = np.flatnonzero(~good & ~np.isnan(values).all(axis=1))
    if len(wrong):
        frame = np.repeat(np.arange(len(counts)), counts)[wrong[0]]
        raise ValueError(f"frame {frame}: features that are zero or not finite")
    return units


def _path(given: tuple[ArrayLike, ArrayLike] | trajectory.Trajectory | None, name: str) -> trajectory.Trajectory | None:
    if given is None or isinstance(given, trajectory.Trajectory):
        return given
    try:
        return Trajectory.from_arrays(*given)
    except ValueError as error:
        raise ValueError(f"{name}: {error}") from error


def _content(camera: types.CameraLog) -> str:
    boxes = None if camera.detections is None else f"{len(camera.detections)} boxes"
    images = None if camera.rgb is None else f"{len(camera.rgb.paths)} images"
    return " and ".join(part for part in (boxes, images) if part) or "nothing"
