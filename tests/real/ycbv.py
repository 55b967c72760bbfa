"""DOPE's poses of one object on YCB-Video as a log: boxes of a real detector from known camera poses."""

import gzip
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from objslam.core.arrays import Bools, Floats
from objslam.core.camera import Camera
from objslam.core.trajectory import Trajectory
from objslam.core.types import CameraLog, Detections, Log, Truth, TruthObject

RUNS = (
    ("cracker_box", "0001"),
    ("cracker_box", "0016"),
    ("potted_meat_can", "0002"),
    ("potted_meat_can", "0005"),
    ("sugar_box", "0001"),
)
SIZES = {
    "cracker_box": (0.072, 0.164, 0.213),
    "potted_meat_can": (0.102, 0.084, 0.058),
    "sugar_box": (0.049, 0.094, 0.176),
}
"""m; the edges of the objects, along the axes of their poses."""
CAMERA = Camera("camera", 640, 480, np.array([[1066.778, 0, 312.9869], [0, 1067.487, 241.3109], [0, 0, 1.0]]))


def read_ycbv(folder: Path, name: str, run: str) -> Log:
    """The boxes have the centre and the size of the object in DOPE's pose. The truth is the median over the frames."""
    stamps, map_T_camera, known = _poses(folder / f"camera_{run}.txt.gz")
    _, seen, found = _poses(folder / f"{name}_{run}_detections.txt.gz")
    _, true, told = _poses(folder / f"{name}_{run}_truth.txt.gz")
    found &= known & (seen[:, 2, 3] > 0.05)
    frame = np.flatnonzero(found)
    place = seen[frame, :3, 3]
    half = np.abs(seen[frame, :2, :3]) @ SIZES[name] / 2 / place[:, 2:]
    focal, centre = CAMERA.matrix[[0, 1], [0, 1]], CAMERA.matrix[:2, 2]
    middle = place[:, :2] / place[:, 2:] * focal + centre
    boxes = np.hstack([middle - half * focal, middle + half * focal])
    few, none = np.zeros(len(frame), dtype=np.int64), np.full(len(frame), np.nan)
    detections = Detections(stamps, frame, boxes, few, few + 1.0, none, few - 1, (name,), whole=True)
    position = np.median((map_T_camera @ true)[known & told, :3, 3], axis=0)
    truth = Truth((TruthObject(0, name, position),), None)
    path = Trajectory(stamps[known], map_T_camera[known])
    return Log(f"{name} {run}", (CameraLog(CAMERA, detections),), None, path, truth)


def _poses(file: Path) -> tuple[Floats, Floats, Bools]:
    with gzip.open(file) as text:
        rows = np.loadtxt(text)
    known = np.isfinite(rows).all(axis=1) & (np.linalg.norm(rows[:, 4:8], axis=1) > 0.5)
    poses = np.tile(np.eye(4), (len(rows), 1, 1))
    poses[:, :3, 3] = np.nan_to_num(rows[:, 1:4])
    poses[known, :3, :3] = Rotation.from_quat(rows[known, 4:8]).as_matrix()
    return rows[:, 0], poses, known
