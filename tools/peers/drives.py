"""Read or simulate planar drives: odometry, and ranges and bearings to landmarks whose numbers are known."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import gtsam
import numpy as np
from scipy.io import loadmat

from objslam.core.arrays import Floats, Ints
from objslam.core.camera import Camera
from objslam.core.diagnostics import Ledger
from objslam.core.geometry import lift_se2, split_se2
from objslam.core.trajectory import Trajectory
from objslam.core.types import CameraLog, Detections, Log, Truth, TruthObject
from objslam.simulation import make_camera
from objslam.sources import SourceOptions, read
from objslam.sources.mrclam.reader import integrate

_YAWS = np.radians([-80.0, 0.0, 80.0])
"""Where the three cameras look, whose images together show what a laser with a view of 240 degrees sees."""
_WIDTH, _FOCAL = 640, 320 / np.tan(np.radians(40.0))
"""The width (px) and the focal length (px) of these cameras. Larger focal lengths see less."""
_HALF_BOX = 4.0
"""Half the side of a box, px. The drives have no boxes, so small ones are made."""


@dataclass(frozen=True)
class Drive:
    """A drive as graphs written by hand take it, and as the log that objslam maps.

    poses: (F, 3) x, y, yaw of the sensor at each frame, by dead reckoning. frame, landmark: (M,) of each observation.
    range: (M,) m. bearing: (M,) rad. noise: (F-1, 3) m, m, rad of each step. range_noise: m. bearing_noise: rad.
    truth: (N, 2) m of the landmarks, None if nobody knows it. cameras: how many cameras the log has.
    """

    name: str
    poses: Floats
    frame: Ints
    landmark: Ints
    range: Floats
    bearing: Floats
    noise: Floats
    range_noise: float
    bearing_noise: float
    truth: Floats | None
    log: Log

    @property
    def count(self) -> int:
        """The number of landmarks."""
        return int(self.landmark.max()) + 1


def drives(data: Path | None) -> dict[str, Callable[[], Drive] | str]:
    """Return for each name the function that reads this drive, or the reason why it is left out."""
    found: dict[str, Callable[[], Drive] | str] = {}
    none = "OBJSLAM_DATA names no folder with it"
    woods = data / "lost_in_the_woods" if data else None
    found["lost in the woods"] = (lambda: _woods(woods)) if woods and woods.is_dir() else none
    victoria = Path(gtsam.__file__).parent / "Data" / "victoria_park.txt"
    missing = f"the installed gtsam has no {victoria.name}"
    found["Victoria Park"] = (lambda: _victoria(victoria)) if victoria.is_file() else missing
    folder = data / "mrclam_ds6" if data else None
    for robot in (1, 3, 5):
        there = folder is not None and folder.is_dir()
        found[f"MRCLAM 6, robot {robot}"] = (lambda robot=robot: _mrclam(folder, robot)) if there else none
    found["simulated, 50,000 rays"] = lambda: _simulated(50_000)
    return found


def _woods(folder: Path) -> Drive:
    """One observation a second, with the noise that the data's authors measured."""
    data = loadmat(folder / "dataset2.mat")
    stamps, forward, turn = (data[name][:, 0] for name in ("t", "v", "om"))
    path = integrate(stamps, np.column_stack([forward, turn]))
    frames = np.arange(0, len(stamps), 10)
    ranges = data["r"][frames]
    frame, landmark = np.nonzero(ranges > 0)
    ahead = float(data["d"][0, 0])
    heading = np.column_stack([np.cos(path[frames, 2]), np.sin(path[frames, 2])])
    poses = np.column_stack([path[frames, :2] + ahead * heading, path[frames, 2]])
    # A step sums up the independent noise of ten speeds, each of which holds for a tenth of a second.
    way, angle = (0.1 * np.sqrt(10 * float(data[name][0, 0])) for name in ("v_var", "om_var"))
    noise = np.tile([way, 0.02, angle], (len(frames) - 1, 1))
    bearing = data["b"][frames][frame, landmark]
    distance, odometry = ranges[frame, landmark], Trajectory(stamps, lift_se2(path))
    log = _rig_log("woods", odometry, stamps[frames], (frame, landmark), distance, bearing, ahead)
    sigmas = (float(np.sqrt(data[name][0, 0])) for name in ("r_var", "b_var"))
    return Drive("lost in the woods", poses, frame, landmark, distance, bearing, noise, *sigmas, data["l"], log)


def _victoria(path: Path) -> Drive:
    """Read a file in which poses and trees share one numbering. The upper triangle of a covariance follows each
    measurement."""
    steps, trees = [], []
    number = {0: 0}
    for line in path.read_text().splitlines():
        kind, first, second, *rest = line.split()
        values = [float(word) for word in rest]
        if kind == "ODOMETRY":
            number[int(second)] = len(number)
            steps.append([*values[:3], *np.sqrt([values[3], values[6], values[8]])])
        elif kind == "LANDMARK":
            trees.append([number[int(first)], int(second), *values[:2], np.sqrt(values[2])])
    step = np.array(steps)
    yaw = np.append(0.0, np.cumsum(step[:, 2]))
    c, s = np.cos(yaw[:-1]), np.sin(yaw[:-1])
    moves = np.column_stack([c * step[:, 0] - s * step[:, 1], s * step[:, 0] + c * step[:, 1]])
    poses = np.column_stack([np.vstack([np.zeros(2), np.cumsum(moves, axis=0)]), yaw])
    seen = np.array(trees)
    frame, landmark = seen[:, 0].astype(np.int64), np.unique(seen[:, 1], return_inverse=True)[1]
    distance, bearing = np.hypot(seen[:, 2], seen[:, 3]), np.arctan2(seen[:, 3], seen[:, 2])
    stamps = 0.1 * np.arange(len(poses))  # The file has none.
    log = _rig_log("victoria", Trajectory(stamps, lift_se2(poses)), stamps, (frame, landmark), distance, bearing, 0.0)
    spread = float(np.median(seen[:, 4]))
    sideways = spread / float(np.median(distance))
    return Drive("Victoria Park", poses, frame, landmark, distance, bearing, step[:, 3:], spread, sideways, None, log)


def _mrclam(folder: Path, robot: int) -> Drive:
    log = read(folder, Ledger(), SourceOptions(robot=robot))
    found, odometry = log.cameras[0].detections, log.odometry
    assert found is not None
    assert odometry is not None
    assert log.truth is not None
    seen, frame = np.unique(found.frame, return_inverse=True)
    stamps = np.clip(found.frame_stamps[seen], odometry.stamps[0], odometry.stamps[-1])
    path = split_se2(odometry.poses)[0]
    path[:, 2] = np.unwrap(path[:, 2])
    poses = np.column_stack([np.interp(stamps, odometry.stamps, column) for column in path.T])
    matrix = log.cameras[0].camera.matrix
    bearing = np.arctan((matrix[0, 2] - (found.boxes[:, 0] + found.boxes[:, 2]) / 2) / matrix[0, 0])
    at = {o.label: o.position[:2] for o in log.truth.objects}
    truth = np.array([at.get(name, [np.nan, np.nan]) for name in found.label_names])
    noise = _wheel_noise(poses)
    distance = found.depths / np.cos(bearing)
    name = f"MRCLAM 6, robot {robot}"
    return Drive(name, poses, frame, found.label, distance, bearing, noise, 0.15, np.radians(0.5), truth, log)


def _simulated(rays: int, seed: int = 0) -> Drive:
    """Laps on a circle between landmarks, five observations a frame."""
    rng = np.random.default_rng(seed)
    frames, count = rays // 5, rays // 200
    radius = 10.0 * np.sqrt(count / 20)
    turned = 0.1 * np.arange(frames) / radius
    true = np.column_stack([radius * np.sin(turned), radius * (1 - np.cos(turned)), turned])
    ring, out = rng.uniform(0, 2 * np.pi, count), radius + rng.choice([-1, 1], count) * rng.uniform(1.5, 4, count)
    truth = np.column_stack([out * np.sin(ring), radius - out * np.cos(ring)])
    frame, landmark = [], []
    for k, (x, y, yaw) in enumerate(true):
        ahead = (truth - [x, y]) @ [np.cos(yaw), np.sin(yaw)]
        near = np.argsort(np.hypot(*(truth - [x, y]).T) + 1000.0 * (ahead < 0.3), kind="stable")[:5]
        frame += [k] * len(near)
        landmark += near.tolist()
    at, mark = np.array(frame), np.array(landmark)
    to = truth[mark] - true[at, :2]
    ahead = np.arctan2(to[:, 1], to[:, 0]) - true[at, 2]
    ahead = (ahead + np.pi) % (2 * np.pi) - np.pi
    bearing = ahead + rng.normal(scale=0.006, size=len(at))
    distance = np.hypot(*to.T) * (1 + rng.normal(scale=0.02, size=len(at)))
    noise = np.tile([0.004, 0.002, 0.002], (frames - 1, 1))
    turn = 0.1 / radius
    chord = radius * np.array([np.sin(turn), 1 - np.cos(turn)])
    step = np.array([*chord, turn]) + noise * rng.normal(size=noise.shape)
    yaw = np.append(0.0, np.cumsum(step[:, 2]))
    c, s = np.cos(yaw[:-1]), np.sin(yaw[:-1])
    moves = np.column_stack([c * step[:, 0] - s * step[:, 1], s * step[:, 0] + c * step[:, 1]])
    poses = np.column_stack([np.vstack([np.zeros(2), np.cumsum(moves, axis=0)]), yaw])
    stamps = 0.2 * np.arange(frames)
    odometry = Trajectory(stamps, lift_se2(poses))
    log = _rig_log("simulated", odometry, stamps, (at, mark), distance, bearing, 0.0, toward=ahead)
    return Drive("simulated, 50,000 rays", poses, at, mark, distance, bearing, noise, 0.1, 0.006, truth, log)


def _wheel_noise(poses: Floats) -> Floats:
    """Return the noise (F-1, 3) of steps if the data do not state it: that of wheels, which grows with the way and the
    turn."""
    way, turn = np.hypot(*np.diff(poses[:, :2], axis=0).T), np.abs(np.diff(poses[:, 2]))
    return np.column_stack([0.02 + 0.05 * way, 0.01 + 0.02 * way, 0.01 + 0.05 * turn])


def _rig_log(
    name: str,
    odometry: Trajectory,
    stamps: Floats,
    seen: tuple[Ints, Ints],
    ranges: Floats,
    bearing: Floats,
    ahead: float,
    toward: Floats | None = None,
) -> Log:
    """Return the log of a rig of pinhole cameras at the place of the laser, of which each sees a third of its view.

    toward: (n,) rad, the true bearings, which say what camera sees a landmark. None means that they are not known. If the
    measured ones decided, bearings whose noise points out of the image would be missing, which moves the image's centre.
    """
    toward = bearing if toward is None else toward
    frame, landmark = seen
    names = tuple(f"landmark {i}" for i in range(int(landmark.max()) + 1))
    nearest = np.argmin(np.abs(toward[:, None] - _YAWS), axis=1)
    cameras = []
    for i, yaw in enumerate(_YAWS.tolist()):
        mine = np.flatnonzero((nearest == i) & (np.abs(toward - yaw) < np.radians(39.0)))
        mine = mine[np.argsort(frame[mine], kind="stable")]
        aside = bearing[mine] - yaw
        centre = np.column_stack([_WIDTH / 2 - _FOCAL * np.tan(aside), np.full(len(mine), 240.0)])
        mount = make_camera(position=(ahead, 0.0, 0.0), yaw=yaw).base_T_camera
        matrix = np.array([[_FOCAL, 0.0, _WIDTH / 2], [0.0, _FOCAL, 240.0], [0.0, 0.0, 1.0]])
        boxes = np.hstack([centre - _HALF_BOX, centre + _HALF_BOX])
        whole, none = np.ones(len(mine)), np.full(len(mine), -1)
        depth = ranges[mine] * np.cos(aside)
        found = Detections(stamps, frame[mine], boxes, landmark[mine], whole, depth, none, names, whole=True)
        cameras.append(CameraLog(Camera(f"camera{i}", _WIDTH, 480, matrix, base_T_camera=mount, sees_size=False), found))
    return Log(name=name, cameras=tuple(cameras), odometry=odometry, truth=Truth((TruthObject(0, names[0], np.zeros(3)),)))
