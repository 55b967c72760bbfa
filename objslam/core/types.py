"""The data types of the pipeline: frozen dataclasses of arrays that check their shapes when they are made.

Coordinate frames follow REP 103/105: `map`, `odom`, `base` (x forward, y left, z up), `camera` (optical: x right, y down, z
forward). `a_T_b` is the pose of b in a. It transforms coordinates in b to coordinates in a. Units are SI, angles in radians.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal, Self

import numpy as np

from objslam.core.appearance.features import FeatureTable, are_unit_vectors
from objslam.core.arrays import Bools, Floats, Floats32, Ints, need
from objslam.core.bodies.cut_boxes import CutBoxes
from objslam.core.camera import Camera
from objslam.core.diagnostics import Ledger
from objslam.core.statistics import WHITE, Lasting
from objslam.core.trajectory import Trajectory

MAX_BOXES = 10_000
"""The most boxes of a frame. No detector finds more, so frames with more are rejected. A larger number may be too slow."""
Up = Literal["x", "y", "z", "-x", "-y", "-z"]
"""The axis of a map's frame that points up in the world, with its sign."""


_BOX_COLUMNS = ("frame", "label", "scores", "depths", "track_ids")  # The fields of Detections with one number per box.


@dataclass(frozen=True)
class Detections:
    """All boxes of one camera. A frame is one image. Frames without a box are kept, because they show what the camera did
    not see.

    frame_stamps: (F,) s, strictly increasing. frame: (M,) index into frame_stamps, non-decreasing. boxes: (M, 4) x1, y1, x2,
    y2 in px of the raw (distorted) image. label: (M,) index into label_names. scores: (M,) in [0, 1]. depths: (M,) z along
    the optical axis, m, NaN if unknown. track_ids: (M,) -1 if unknown. whole: whether the image's edge cuts off no box. This
    is true for fiducials, because a detector must see all their corners. If true, the centres of boxes at the edge are also
    valid. corners: (M, 4, 2) px of the raw image, the corners of a square fiducial in its own order, NaN for another box.
    None if no box has corners. features: (M, D) unit appearance vectors, a row of NaN for a box without one. None if no box
    has one. second: (M,) index into label_names, the label of a box that was dropped because it lay on this box. It is -1
    for a box without such a label, and None if no box has such a label. ValueError if a shape, an index or the order is
    wrong.
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
    corners: Floats | None = None
    features: Floats32 | None = None
    second: Ints | None = None

    def __post_init__(self) -> None:
        m = len(self.frame)
        need(self.boxes.shape == (m, 4), "boxes must be (M, 4)")
        for name in _BOX_COLUMNS:
            need(getattr(self, name).shape == (m,), f"{name} must be (M,) like the boxes")
        need(self.corners is None or self.corners.shape == (m, 4, 2), "corners must be (M, 4, 2) like the boxes")
        if self.features is not None:
            need(self.features.ndim == 2 and len(self.features) == m, "features must be (M, D) like the boxes")
            need(self.features.dtype == np.float32 and are_unit_vectors(self.features), "features must be unit float32 rows")
        need((np.diff(self.frame_stamps) > 0).all(), "the stamps of the frames must increase")
        need((np.diff(self.frame) >= 0).all(), "boxes must come in the order of their frames")
        if m:
            need(0 <= self.frame.min() and self.frame.max() < len(self.frame_stamps), "frame must index frame_stamps")
            need(0 <= self.label.min() and self.label.max() < len(self.label_names), "label must index label_names")

    def __len__(self) -> int:
        return len(self.frame)

    @property
    def stamps(self) -> Floats:
        """(M,) s, the stamp of the frame of each box."""
        return self.frame_stamps[self.frame]

    @property
    def labels(self) -> list[str]:
        """The label of each box as text."""
        return [self.label_names[i] for i in self.label.tolist()]

    def take(self, boxes: Bools | Ints) -> Self:
        """Select boxes by a mask or increasing indices. All frames stay."""
        values: dict[str, Any] = {name: getattr(self, name)[boxes] for name in ("boxes", *_BOX_COLUMNS)}
        more = ("corners", "features", "second")
        values |= {name: given[boxes] for name in more if (given := getattr(self, name)) is not None}
        return replace(self, **values)


@dataclass(frozen=True)
class Images:
    """The image files of one stream. stamps: (N,) s, strictly increasing. paths: one for each stamp."""

    stamps: Floats
    paths: tuple[Path, ...]

    def __post_init__(self) -> None:
        need(self.stamps.shape == (len(self.paths),), "images need one stamp for each path")
        need((np.diff(self.stamps) > 0).all(), "the stamps of images must increase")


@dataclass(frozen=True)
class CameraLog:
    """The data of one camera. mount: base_T_camera over time, for a camera that moves on the robot. None for a camera that
    does not move."""

    camera: Camera
    detections: Detections | None = None
    rgb: Images | None = None
    depth: Images | None = None
    mount: Trajectory | None = None


@dataclass(frozen=True)
class TruthObject:
    """One object of the ground truth. position: (3,) m in map. size: (3,) m, length, width and height. yaw: rad, the
    direction of its length. tag_xyzw: (4,) the unit quaternion of map_R_tag of a fiducial. None means unknown."""

    id: int
    label: str
    position: Floats
    size: Floats | None = None
    yaw: float | None = None
    tag_xyzw: Floats | None = None


@dataclass(frozen=True)
class Truth:
    """Ground truth for evaluation: the objects, and map_T_base if it is known."""

    objects: tuple[TruthObject, ...] = ()
    trajectory: Trajectory | None = None


@dataclass(frozen=True)
class Log:
    """The log of a robot, with odometry, localisation or both.

    odometry: odom_T_base. localization: map_T_base. path: the absolute path of the file or folder that was read, None for a
    log from memory. reading: the data dropped while the log was read, None if they were not counted. part: the begin and the
    end, s, if the log is a part of a longer log. The end is outside the part. None means no limit.
    """

    name: str
    cameras: tuple[CameraLog, ...]
    odometry: Trajectory | None = None
    localization: Trajectory | None = None
    truth: Truth | None = None
    path: Path | None = None
    reading: Ledger | None = None
    part: tuple[float | None, float | None] = (None, None)

    @property
    def robot_path(self) -> Trajectory | None:
        """The path that gives keyframes their poses: the localisation if it has poses, else the odometry, else None."""
        return next((path for path in (self.localization, self.odometry) if path is not None and len(path)), None)


@dataclass(frozen=True)
class Keyframes:
    """Frames of all cameras, in the order of time, with the robot poses before the estimation.

    stamps: (K,) s, non-decreasing for each camera. The clocks of several cameras may differ. camera: (K,) index into
    log.cameras. frame: (K,) index into detections.frame_stamps of this camera. base_T_camera: (K, 4, 4). map_T_base: (K, 4,
    4) from the localisation, or from the odometry if there is no localisation. localized_every: how many keyframes there are
    for each measured absolute pose, on average and at least 1. 0 if map_T_base is odometry. localized_at: (K,) s, the stamp
    of the measurement of the localisation that gave the pose, NaN if the odometry continued the localisation. None if each
    pose was measured by itself. carried: (K, 2) rad^2 and m^2, the variance that the odometry from this measurement to the
    keyframe adds to heading and place, None if it adds nothing. overlap: the share of the keyframes of one moment that can
    show the same thing: 1 for one camera, a quarter for four that look to four sides. pose_noise: the factors on
    `localization.yaw` and `localization.xy` that the log shows, 1 if they are not estimated. lasting: the parts of the
    errors of headings and of places that last, in joint mode. odom_T_base: (K, 4, 4) in the frame of the first odometry
    pose, None without odometry. drift: (K, 6, 6) covariance, rotation first, of the odometry's error since its start, in
    this frame. stretch: (K,) the number of the stretch of odometry, between two gaps, that each keyframe is in. None means
    one stretch. It is -1 without odometry, where odom_T_base and drift have no meaning. step: (K,) the place of each
    keyframe among the steps of the odometry. wander: (K, 6) the variance of that step. Both are from `OdometryBridge.at`,
    and None if the odometry is exact between its poses. given_stamps: (K,) s, the stamps of the frames in the log or from
    the robot, None if they are `stamps`. driven: (K,) m, the `way` before any correction, None if there was no correction.
    """

    stamps: Floats
    camera: Ints
    frame: Ints
    base_T_camera: Floats
    map_T_base: Floats
    localized_every: float = 0.0
    localized_at: Floats | None = None
    carried: Floats | None = None
    overlap: float = 1.0
    pose_noise: tuple[float, float] = (1.0, 1.0)
    lasting: tuple[Lasting, Lasting] = (WHITE, WHITE)
    odom_T_base: Floats | None = None
    drift: Floats | None = None
    stretch: Ints | None = None
    step: Floats | None = None
    wander: Floats | None = None
    given_stamps: Floats | None = None
    driven: Floats | None = None

    def __len__(self) -> int:
        return len(self.stamps)

    @property
    def frame_stamps(self) -> Floats:
        """(K,) s, the stamps of the frames before any correction of a clock."""
        return self.stamps if self.given_stamps is None else self.given_stamps

    @property
    def map_T_camera(self) -> Floats:
        """(K, 4, 4) camera poses in map."""
        return self.map_T_base @ self.base_T_camera

    @property
    def measured(self) -> Bools:
        """(K-1,) whether the odometry measured the motion between two consecutive keyframes.

        A motion across a gap counts only without a localisation, because somebody may have moved the robot.
        """
        steps = max(len(self) - 1, 0)
        if self.odom_T_base is None:
            return np.zeros(steps, dtype=bool)
        if self.stretch is None or not self.localized_every:
            return np.ones(steps, dtype=bool)
        return (self.stretch[1:] == self.stretch[:-1]) & (self.stretch[1:] >= 0)

    @property
    def way(self) -> Floats:
        """(K,) m, how far the robot had driven, by the odometry where it measured the motion, else by the localisation."""
        steps = np.linalg.norm(np.diff(self.map_T_base[:, :3, 3], axis=0), axis=1)
        if self.odom_T_base is not None:
            by_odometry = np.linalg.norm(np.diff(self.odom_T_base[:, :3, 3], axis=0), axis=1)
            steps = np.where(self.measured, by_odometry, steps)
        return np.append(0.0, np.cumsum(steps))

    def take(self, keyframes: Bools | Ints) -> Self:
        """Select keyframes by a mask or by indices."""
        return replace(self, **_rows(self, keyframes))


@dataclass(frozen=True)
class Rays:
    """Bearing rays, one for each box. A ray runs from the camera at a keyframe through the undistorted centre of the box.

    keyframe: (R,) index into Keyframes, non-decreasing. direction: (R, 3) unit, in the camera frame. sigma: (R,) rad, the
    nominal noise: the standard deviation of the angle along each of the two axes across the ray. range: (R,) m along the
    ray, NaN if unknown. range_sigma: (R,) m, the standard deviation of the range. range_bias: (R,) m, the standard deviation
    of the error that all ranges of an object share. label: (R,) index into label_names. score: (R,). box: (R, 4) raw px.
    track_id: (R,) -1 if unknown. offset: (R, 3) m, where each ray begins in the frame of its direction. None means at the
    origin. corners: (R, 4, 3) unit, in the camera frame, the directions to the corners of a square fiducial, NaN for another
    object. None if no ray has corners. corner_sigma: (R,) rad, the nominal noise of each corner along each of two axes. cut:
    the cut off boxes of the same images, None if they were not collected. feature: (R,) the row of each ray's appearance
    vector in feature_table, -1 without a vector. feature and feature_table are None if no ray has a vector. surface: (R, 2)
    two numbers for each range. Ranges were lengthened from the surface of a thing to its centre. The first number is the
    added length, as a share of half the width. The second is the weight with which the shared error `surface` is added to
    this share. None means `depth.centre` and 1. second: (R,) the second label of each box, as in `Detections`.
    """

    keyframe: Ints
    direction: Floats
    sigma: Floats
    range: Floats
    range_sigma: Floats
    range_bias: Floats
    label: Ints
    score: Floats
    box: Floats
    track_id: Ints
    label_names: tuple[str, ...]
    offset: Floats | None = None
    corners: Floats | None = None
    corner_sigma: Floats | None = None
    cut: CutBoxes | None = None
    feature: Ints | None = None
    feature_table: FeatureTable | None = None
    surface: Floats | None = None
    second: Ints | None = None

    def __len__(self) -> int:
        return len(self.keyframe)

    def in_map(self, map_T_camera: Floats) -> tuple[Floats, Floats]:
        """Return origins (R, 3) and unit directions (R, 3) in map for camera poses (K, 4, 4)."""
        poses = map_T_camera[self.keyframe]
        origins, rotations = poses[:, :3, 3], poses[:, :3, :3]
        if self.offset is not None:
            origins = origins + np.einsum("rij,rj->ri", rotations, self.offset)
        return origins, np.einsum("rij,rj->ri", rotations, self.direction)

    def take(self, rays: Bools | Ints) -> Self:
        """Select rays by a mask or by indices."""
        return replace(self, **_rows(self, rays))


def _rows(data: Keyframes | Rays, rows: Bools | Ints) -> dict[str, Any]:
    """Return the selected rows of every array of a dataclass."""
    return {name: value[rows] for name, value in vars(data).items() if isinstance(value, np.ndarray)}


@dataclass(frozen=True)
class Association:
    """The object of each ray.

    object: (R,) index of the object, or -1. label: (N,) the label of each object, as an index into label_names of the rays.
    label_weights: (N, L) the share of each label among the boxes of each object, None if unknown. existence: (N,) the
    probability that the object exists, NaN or None if unknown. refuted: (R,) whether a ray is of an object that was dropped,
    None if unknown. few_rays: (N,) whether the search for objects with few rays found the object, None without it.
    """

    object: Ints
    label: Ints
    label_weights: Floats | None = None
    existence: Floats | None = None
    refuted: Bools | None = None
    few_rays: Bools | None = None

    @property
    def count(self) -> int:
        """Number of objects, N."""
        return len(self.label)


def label_table(names: Sequence[str]) -> tuple[tuple[str, ...], Ints]:
    """Return the distinct names in sorted order, and for each of the names (len(names),) its index among them."""
    table = tuple(sorted({str(name) for name in names}))  # The repr of numpy's own text type looks odd in messages.
    index = {name: i for i, name in enumerate(table)}
    return table, np.array([index[name] for name in names], dtype=np.int64)
