"""Put one mistake into a log, as if a user had recorded or converted it with wrong units, axes, stamps or calibration."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from objslam.core.arrays import Floats
from objslam.core.camera import Camera
from objslam.core.geometry import exp_se3, inverse, make_pose
from objslam.core.types import CameraLog, Detections, Log
from objslam.mapping.checks.hypotheses.every import with_frame_stamps, with_poses
from objslam.mapping.checks.hypotheses.hypothesis import with_cameras

Mistake = Callable[[Log], Log]


def with_boxes(log: Log, change: Callable[[Floats, Camera], Floats]) -> Log:
    """Return the log with the boxes (M, 4) of each camera changed."""

    def changed(one: CameraLog) -> CameraLog:
        found = one.detections
        return one if found is None else replace(one, detections=replace(found, boxes=change(found.boxes, one.camera)))

    return with_cameras(log, changed)


def _camera(change: Callable[[Camera], Camera]) -> Mistake:
    return lambda log: with_cameras(log, lambda one: replace(one, camera=change(one.camera)))


def _mount(change: Callable[[Floats], Floats]) -> Mistake:
    return _camera(lambda camera: replace(camera, base_T_camera=change(camera.base_T_camera)))


def _turned(roll: float, pitch: float, yaw: float) -> Mistake:
    """Return the mistake that each camera is turned about the axes of base, by angles in degrees."""
    turn = exp_se3(np.append(np.zeros(3), np.radians([roll, pitch, yaw])))
    turn[:3, :3] = Rotation.from_euler("xyz", [roll, pitch, yaw], degrees=True).as_matrix()
    return _mount(lambda pose: make_pose(turn[:3, :3] @ pose[:3, :3], pose[:3, 3]))


def _moved(x: float, y: float, z: float) -> Mistake:
    return _mount(lambda pose: make_pose(pose[:3, :3], pose[:3, 3] + [x, y, z]))


def _matrix(focal: float, across: float) -> Mistake:
    def changed(camera: Camera) -> Camera:
        matrix = camera.matrix * np.array([[focal, 1, 1], [1, focal, 1], [1, 1, 1]])
        matrix[0, 2] += across
        return replace(camera, matrix=matrix)

    return _camera(changed)


def _scaled(factor: float) -> Callable[[Floats], Floats]:
    def change(poses: Floats) -> Floats:
        return make_pose(poses[:, :3, :3], factor * poses[:, :3, 3])

    return change


def _swapped(poses: Floats) -> Floats:
    return make_pose(poses[:, :3, :3], poses[:, [1, 0, 2], 3])


def _y_negated(poses: Floats) -> Floats:
    return make_pose(poses[:, :3, :3], poses[:, :3, 3] * [1, -1, 1])


def _yaw_times(factor: float) -> Callable[[Floats], Floats]:
    def change(poses: Floats) -> Floats:
        yaw = np.unwrap(np.arctan2(poses[:, 1, 0], poses[:, 0, 0]))
        turned = Rotation.from_rotvec(np.outer(factor * yaw, [0.0, 0.0, 1.0])).as_matrix()
        return make_pose(turned, poses[:, :3, 3])

    return change


def _w_first(poses: Floats) -> Floats:
    xyzw = Rotation.from_matrix(poses[:, :3, :3]).as_quat()
    return make_pose(Rotation.from_quat(xyzw[:, [3, 0, 1, 2]]).as_matrix(), poses[:, :3, 3])


def _frozen(begin: float) -> Mistake:
    """Return the mistake that the poses stay the same from the share `begin` (0 to 1) of the log on."""

    def change(poses: Floats) -> Floats:
        first = int(begin * (len(poses) - 1))
        return np.concatenate([poses[:first], np.repeat(poses[first : first + 1], len(poses) - first, axis=0)])

    return lambda log: with_poses(log, change)


def _jumping(poses: Floats) -> Floats:
    """Return poses (N, 4, 4) that jump aside by 2 m three times."""
    jump = np.floor(4 * np.arange(len(poses)) / len(poses))
    return make_pose(poses[:, :3, :3], poses[:, :3, 3] + jump[:, None] * [1.2, 1.6, 0.0])


def _other_map(poses: Floats) -> Floats:
    """Return poses (N, 4, 4), with the second half in the coordinates of another map."""
    other = make_pose(Rotation.from_euler("z", 100, degrees=True).as_matrix(), np.array([2.0, -1.0, 0.0]))
    return np.asarray(np.where((np.arange(len(poses)) < len(poses) // 2)[:, None, None], poses, other @ poses))


def _mirrored(boxes: Floats, camera: Camera) -> Floats:
    return np.stack([camera.width - 1 - boxes[:, 2], boxes[:, 1], camera.width - 1 - boxes[:, 0], boxes[:, 3]], axis=1)


def _bent(boxes: Floats, camera: Camera) -> Floats:
    """Return the boxes of images with a barrel distortion, of cameras without distortion."""
    middle, focal = camera.matrix[:2, 2], np.diag(camera.matrix)[:2]
    points = (boxes.reshape(-1, 2, 2) - middle) / focal
    radius = np.linalg.norm(points, axis=-1, keepdims=True)
    return ((points * (1 - 0.25 * radius**2 + 0.06 * radius**4)) * focal + middle).reshape(-1, 4)


def _upside_down(boxes: Floats, camera: Camera) -> Floats:
    return np.asarray((np.tile(camera.size - 1, 2) - boxes)[:, [2, 3, 0, 1]])


def _xywh(boxes: Floats, camera: Camera) -> Floats:
    return np.concatenate([boxes[:, :2], boxes[:, 2:] - boxes[:, :2]], axis=1)


def _cxcywh(boxes: Floats, camera: Camera) -> Floats:
    return np.concatenate([(boxes[:, :2] + boxes[:, 2:]) / 2, boxes[:, 2:] - boxes[:, :2]], axis=1)


def _depth(factor: float) -> Mistake:
    def changed(one: CameraLog) -> CameraLog:
        camera, found = one.camera, one.detections
        if found is not None:
            found = replace(found, depths=found.depths * factor)
        return replace(one, camera=replace(camera, depth_scale=camera.depth_scale / factor), detections=found)

    return lambda log: with_cameras(log, changed)


def _camera_moved(log: Log) -> Log:
    """Return a log in which somebody turned each camera by 10 degrees in the middle: the boxes move, but the calibration
    stays."""

    def changed(one: CameraLog) -> CameraLog:
        found, camera = one.detections, one.camera
        if found is None:
            return one
        late = (found.frame >= len(found.frame_stamps) // 2)[:, None]
        shift = camera.matrix[0, 0] * np.tan(np.radians(10)) * np.array([1.0, 0.0, 1.0, 0.0])
        return replace(one, detections=replace(found, boxes=np.where(late, found.boxes + shift, found.boxes)))

    return with_cameras(log, changed)


def join(first: Log, second: Log, *, interleaved: bool) -> Log:
    """Return a log with boxes of two recordings. If `interleaved`, their frames alternate, else each gives one half.

    Poses, stamps and calibration are from the first recording.
    """

    def boxes_of(a: Detections, b: Detections) -> Detections:
        n = len(a.frame_stamps)
        frames = np.arange(n)
        late = frames % 2 == 1 if interleaved else frames >= n // 2
        mine, other = ~late[a.frame], (b.frame < n) & late[np.minimum(b.frame, n - 1)]
        frame = np.concatenate([a.frame[mine], b.frame[other]])
        order = np.argsort(frame, kind="stable")
        names = tuple(sorted(set(a.label_names) | set(b.label_names)))
        labels = [np.array([names.index(x) for x in d.label_names])[d.label[k]] for d, k in ((a, mine), (b, other))]
        columns = {
            name: np.concatenate([getattr(a, name)[mine], getattr(b, name)[other]])[order]
            for name in ("boxes", "scores", "depths", "track_ids")
        }
        return Detections(
            frame_stamps=a.frame_stamps,
            frame=frame[order],
            label=np.concatenate(labels)[order],
            label_names=names,
            whole=a.whole,
            **columns,
        )

    cameras = []
    for one, other in zip(first.cameras, second.cameras, strict=True):
        assert one.detections is not None
        assert other.detections is not None
        cameras.append(replace(one, detections=boxes_of(one.detections, other.detections)))
    return replace(first, cameras=tuple(cameras))


MISTAKES: dict[str, Mistake] = {
    "camera yaw +3 deg": _turned(0, 0, 3),
    "camera pitch +3 deg": _turned(0, 3, 0),
    "camera roll +3 deg": _turned(3, 0, 0),
    "camera 0.3 m too high": _moved(0, 0, 0.3),
    "camera 0.2 m aside": _moved(0, 0.2, 0),
    "clock +0.2 s": lambda log: with_frame_stamps(log, lambda stamps: stamps + 0.2),
    "clock +1 s": lambda log: with_frame_stamps(log, lambda stamps: stamps + 1),
    "clock +5 s": lambda log: with_frame_stamps(log, lambda stamps: stamps + 5),
    "frames' stamps in ms": lambda log: with_frame_stamps(log, lambda stamps: 1e3 * stamps),
    "frames' stamps in ns": lambda log: with_frame_stamps(log, lambda stamps: 1e9 * stamps),
    "path scale +5 %": lambda log: with_poses(log, _scaled(1.05)),
    "poses in mm": lambda log: with_poses(log, _scaled(1e3)),
    "focal +10 %": _matrix(1.1, 0),
    "focal -10 %": _matrix(0.9, 0),
    "image centre +20 px": _matrix(1.0, 20),
    "x and y of poses swapped": lambda log: with_poses(log, _swapped),
    "y of poses negated": lambda log: with_poses(log, _y_negated),
    "yaw of poses negated": lambda log: with_poses(log, _yaw_times(-1)),
    "yaw in degrees": lambda log: with_poses(log, _yaw_times(180 / np.pi)),
    "poses' quaternion wxyz": lambda log: with_poses(log, _w_first),
    "map_T_base inverted": lambda log: with_poses(log, inverse),
    "poses frozen": _frozen(0.0),
    "poses frozen at half": _frozen(0.5),
    "poses jump": lambda log: with_poses(log, _jumping),
    "second half in another map": lambda log: with_poses(log, _other_map),
    "base_T_camera inverted": _mount(inverse),
    "base_T_camera identity": _mount(lambda pose: np.eye(4)),
    "base_T_camera yaw +90 deg": _turned(0, 0, 90),
    "base_T_camera pitch +90 deg": _turned(0, 90, 0),
    "base_T_camera roll +90 deg": _turned(90, 0, 0),
    "camera moved in the middle": _camera_moved,
    "boxes of rectified images": _camera(lambda camera: replace(camera, distortion=np.array([-0.3, 0.1, 0.0, 0.0, 0.0]))),
    "boxes of raw images": lambda log: with_boxes(log, _bent),
    "image mirrored": lambda log: with_boxes(log, _mirrored),
    "image upside down": lambda log: with_boxes(log, _upside_down),
    "boxes 0..1": lambda log: with_boxes(log, lambda boxes, camera: boxes / np.tile(camera.size, 2)),
    "boxes xywh": lambda log: with_boxes(log, _xywh),
    "boxes cxcywh": lambda log: with_boxes(log, _cxcywh),
    "boxes yxyx": lambda log: with_boxes(log, lambda boxes, camera: boxes[:, [1, 0, 3, 2]]),
    "boxes of half the image size": lambda log: with_boxes(log, lambda boxes, camera: boxes / 2),
    "boxes of twice the image size": lambda log: with_boxes(log, lambda boxes, camera: boxes * 2),
    "depth in mm": _depth(1e3),
    "depth in feet": _depth(3.28084),
    "depth +10 %": _depth(1.1),
}
"""Mistakes by name. Each gives the log that a user with this mistake would have."""
