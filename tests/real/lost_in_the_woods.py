"""Lost in the woods (Barfoot, University of Toronto, AER1513): a real robot with wheels and a laser among 17 posts.

The laser tells range, bearing and number of each post over 240 degrees. Three pinhole cameras of 80 degrees at its place
see as much, so the log is that of a rig whose images share their stamps.
"""

from pathlib import Path

import numpy as np
from scipy.io import loadmat

from objslam.core.arrays import Floats
from objslam.core.camera import Camera
from objslam.core.geometry import lift_se2
from objslam.core.trajectory import Trajectory
from objslam.core.types import CameraLog, Detections, Log, Truth, TruthObject
from objslam.simulation import make_camera
from objslam.sources.mrclam.reader import integrate

YAWS = {"right": np.radians(-80.0), "front": 0.0, "left": np.radians(80.0)}
WIDTH, HEIGHT = 640, 480  # px
FOCAL = WIDTH / 2 / np.tan(np.radians(40.0))  # px
HALF_BOX = 4.0  # px
ROWS = 10  # of the file, a second


def read_lost_in_the_woods(folder: Path, seconds: float = np.inf, every: int = 1, with_range: bool = True) -> Log:
    """Read the first `seconds` of the drive, with observations every `every` seconds.

    Depths are z in the camera that sees the post.
    """
    data = loadmat(folder / "dataset2.mat")
    rows = data["t"][:, 0] <= seconds
    stamps, forward, turn = (data[name][rows, 0] for name in ("t", "v", "om"))
    frames = np.flatnonzero(rows)[:: ROWS * every]
    known = data["true_valid"][rows, 0] == 1
    path = np.column_stack([data[name][rows, 0] for name in ("x_true", "y_true", "th_true")])[known]
    posts = tuple(TruthObject(i, label_of(i), np.array([x, y, 0.0])) for i, (x, y) in enumerate(data["l"]))
    ahead = float(data["d"][0, 0])
    ranges, bearings = data["r"][frames], data["b"][frames]
    nearest = np.argmin(np.abs(bearings[..., None] - np.array(list(YAWS.values()))), axis=-1)
    return Log(
        name="lost_in_the_woods",
        cameras=tuple(
            camera_log(name, yaw, ahead, stamps[frames], np.where(nearest == i, ranges, 0.0), bearings, with_range)
            for i, (name, yaw) in enumerate(YAWS.items())
        ),
        odometry=Trajectory(stamps, lift_se2(integrate(stamps, np.column_stack([forward, turn])))),
        truth=Truth(posts, Trajectory(stamps[known], lift_se2(path))),
    )


def label_of(post: int) -> str:
    return f"post {post + 1}"


def camera_log(
    name: str, yaw: float, ahead: float, stamps: Floats, ranges: Floats, bearings: Floats, with_range: bool
) -> CameraLog:
    """The posts that one camera sees, of which the ranges (frames, 17) are above 0."""
    frame, post = np.nonzero(ranges > 0)
    aside = bearings[frame, post] - yaw
    centre = np.column_stack([WIDTH / 2 - FOCAL * np.tan(aside), np.full(len(frame), HEIGHT / 2)])
    depth = ranges[frame, post] * np.cos(aside) if with_range else np.full(len(frame), np.nan)
    return CameraLog(
        rig_camera(name, yaw, ahead),
        Detections(
            frame_stamps=stamps,
            frame=frame,
            boxes=np.hstack([centre - HALF_BOX, centre + HALF_BOX]),
            label=post,
            scores=np.ones(len(frame)),
            depths=depth,
            track_ids=np.full(len(frame), -1),
            label_names=tuple(label_of(i) for i in range(ranges.shape[1])),
            whole=True,
        ),
    )


def rig_camera(name: str, yaw: float, ahead: float) -> Camera:
    base_T_camera = make_camera(position=(ahead, 0.0, 0.0), yaw=yaw).base_T_camera
    matrix = np.array([[FOCAL, 0.0, WIDTH / 2], [0.0, FOCAL, HEIGHT / 2], [0.0, 0.0, 1.0]])
    return Camera(name, WIDTH, HEIGHT, matrix, base_T_camera=base_T_camera, sees_size=False)
