"""UTIAS MRCLAM: a robot with wheel odometry and a camera that measures range and bearing to barcode landmarks.

Leung, Halpern, Barfoot, Liu: The UTIAS multi-robot cooperative localization and mapping dataset, IJRR 30(8), 2011. The
bearings become pixels of a virtual pinhole camera that stands in the origin of base and looks forward.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from objslam.core.arrays import Floats
from objslam.core.camera import Camera
from objslam.core.diagnostics import Ledger
from objslam.core.geometry import lift_se2, make_pose
from objslam.core.types import CameraLog, Detections, Log, Trajectory, Truth, TruthObject, label_table
from objslam.errors import LogError
from objslam.io.text import Table, count_drops, in_order, read_table, reading, select
from objslam.sources.mrclam import MrclamOptions

ROBOTS = range(1, 6)  # the subjects that are robots, as the dataset numbers them
LANDMARKS = range(6, 21)  # the subjects that are landmarks
_SUBJECTS = range(ROBOTS.start, LANDMARKS.stop)  # all that bear a barcode

_FOCAL = 380.0  # px, of the virtual camera: the default pixel noise of 3 px is then 0.45 deg, as good as the bearings are
_WIDTH, _HEIGHT = 640, 480  # px, of the virtual camera: it sees +-40 deg, where the real one sees +-30 deg
_HALF_BOX = 4.0  # px; barcodes have a bearing and no box, so half the side of one is chosen small
_MARGIN = 6.0  # px; a bearing that is nearer to the edge of the image is dropped, for its box would count as cut off
_FORWARD = make_pose(np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]), np.zeros(3))
"""base_T_camera: the camera stands in the origin of base and looks along its x axis."""


def is_mrclam(path: Path) -> bool:
    """Whether the folder is one of the MRCLAM datasets."""
    return _find(path, "Barcodes") is not None and bool(robots(path))


def robots(folder: Path) -> tuple[int, ...]:
    """The robots that the folder has odometry of."""
    found = (re.fullmatch(r"Robot(\d+)_Odometry\.dat(\.gz)?", file.name) for file in folder.glob("Robot*_Odometry.dat*"))
    return tuple(sorted({int(match[1]) for match in found if match}))


def read_mrclam(folder: Path, ledger: Ledger, options: MrclamOptions) -> Log:
    """Read one robot of an MRCLAM folder (files .dat or .dat.gz).

    Odometry starts at the identity; each velocity holds until the next. Each stamp of the measurements is a frame, also
    where only other robots were seen. Depths are range * cos(bearing). Labels are landmark_<subject>, or "landmark" for all.
    Truth: landmark positions (z = 0), the robot's path. Sightings of other robots and of unknown barcodes are dropped and
    counted. LogError where a file cannot be used or the robot is not there.
    """
    robot = options.robot
    with reading(folder):
        if robot not in robots(folder):
            there = ", ".join(map(str, robots(folder))) or "none"
            what = "no robot is chosen" if robot is None else f"there is no robot {robot}"
            raise LogError(f"{what}, the folder has: {there}", where=str(folder), hint="--robot chooses one of them")
        prefix = f"Robot{robot}"
        camera = Camera("camera", _WIDTH, _HEIGHT, _matrix(), base_T_camera=_FORWARD, sees_size=False)
        return Log(
            name=f"{folder.resolve().name}_robot{robot}",
            cameras=(CameraLog(camera, _read_measurements(folder, prefix, options, ledger)),),
            odometry=_read_odometry(folder, prefix, ledger),
            truth=_read_truth(folder, prefix, options.anonymous, ledger),
        )


def integrate(stamps: Floats, velocities: Floats) -> Floats:
    """SE(2) poses (N, 3) x, y, yaw at stamps (N,), s, from the identity.

    velocities: (N, 2) forward m/s and turn rad/s; each row holds until the next one, along an exact arc.
    """
    way, turn = (velocities[:-1] * np.diff(stamps)[:, None]).T
    half = turn / 2
    yaw = np.concatenate([[0.0], np.cumsum(turn)])
    chord = way * np.sinc(half / np.pi)
    steps = np.stack([chord * np.cos(yaw[:-1] + half), chord * np.sin(yaw[:-1] + half)], axis=1)
    return np.column_stack([np.vstack([np.zeros((1, 2)), np.cumsum(steps, axis=0)]), yaw])


def bearing_to_pixel(bearing: Floats) -> Floats:
    """The column (px) of the virtual camera where bearings (rad, positive to the left) are seen."""
    return _WIDTH / 2 - _FOCAL * np.tan(bearing)


def _matrix() -> Floats:
    return np.array([[_FOCAL, 0, _WIDTH / 2], [0, _FOCAL, _HEIGHT / 2], [0, 0, 1.0]])


def _find(folder: Path, name: str) -> Path | None:
    return next((f for f in (folder / f"{name}.dat", folder / f"{name}.dat.gz") if f.is_file()), None)


def _read(folder: Path, name: str, columns: int, ledger: Ledger, what: str) -> tuple[Path, Table]:
    path = _find(folder, name)
    if path is None:
        raise LogError(f"there is neither {name}.dat nor {name}.dat.gz", where=str(folder))
    return path, read_table(path, columns, ledger, what)


def _read_forward(folder: Path, name: str, columns: int, ledger: Ledger, what: str) -> tuple[Path, Table]:
    """A table whose first column, the stamp, never goes back; it may repeat."""
    path, table = _read(folder, name, columns, ledger, what)
    forward = in_order(table.values[:, 0], repeats=True)
    return path, select(table, forward, f"{what} line with a stamp that goes back", path, ledger)


def _trajectory(stamps: Floats, xy_yaw: Floats) -> Trajectory:
    first = np.concatenate([[True], np.diff(stamps) > 0])  # a stamp that repeats is no motion: one pose is enough
    return Trajectory(stamps[first], lift_se2(xy_yaw[first]))


def _read_odometry(folder: Path, prefix: str, ledger: Ledger) -> Trajectory:
    _, table = _read_forward(folder, f"{prefix}_Odometry", 3, ledger, "odometry")
    stamps = table.values[:, 0]
    return _trajectory(stamps, integrate(stamps, table.values[:, 1:]))


def _read_measurements(folder: Path, prefix: str, options: MrclamOptions, ledger: Ledger) -> Detections:
    _, barcodes = _read(folder, "Barcodes", 2, ledger, "barcode")
    path, table = _read_forward(folder, f"{prefix}_Measurement", 4, ledger, "measurement")
    subject_of = {code: int(subject) for subject, code in barcodes.values.tolist() if subject in _SUBJECTS}
    stamps, codes, distance, bearing = table.values.T
    subject = np.array([subject_of.get(code, 0) for code in codes.tolist()], dtype=np.int64)
    frame_stamps, frame = np.unique(stamps, return_inverse=True)
    in_view = np.abs(bearing) < np.arctan((_WIDTH / 2 - _MARGIN) / _FOCAL)
    good = np.ones(len(subject), dtype=bool)
    for fine, reason in (
        (subject != 0, "measurement of an unknown barcode"),
        (~np.isin(subject, ROBOTS), "measurement of another robot"),
        (in_view, "measurement with a bearing out of the virtual camera's view"),
    ):
        bad = good & ~fine
        count_drops(reason, int(bad.sum()), (f"{path}:{line}" for line in table.lines[bad]), ledger)
        good &= fine
    depths = distance * np.cos(bearing) if options.with_range else np.full(len(subject), np.nan)
    wrong = good & (depths <= 0)
    places = (f"{path}:{line}" for line in table.lines[wrong])
    count_drops("range that is not above zero (taken as unknown)", int(wrong.sum()), places, ledger)
    depths = np.where(wrong, np.nan, depths)
    label_names, label = label_table([_label(s, options.anonymous) for s in subject[good].tolist()])
    column, row = bearing_to_pixel(bearing[good]), np.full(int(good.sum()), _HEIGHT / 2)
    return Detections(
        frame_stamps=frame_stamps,
        frame=frame[good],
        boxes=np.column_stack([column - _HALF_BOX, row - _HALF_BOX, column + _HALF_BOX, row + _HALF_BOX]),
        label=label,
        scores=np.ones(int(good.sum())),
        depths=depths[good],
        track_ids=np.full(int(good.sum()), -1),
        label_names=label_names,
    )


def _read_truth(folder: Path, prefix: str, anonymous: bool, ledger: Ledger) -> Truth | None:
    objects: tuple[TruthObject, ...] = ()
    if _find(folder, "Landmark_Groundtruth"):
        file, table = _read(folder, "Landmark_Groundtruth", 5, ledger, "landmark")
        known = np.isin(table.values[:, 0], LANDMARKS)
        table = select(table, known, "landmark line whose subject is no landmark", file, ledger)
        positions = {int(subject): np.array([x, y, 0.0]) for subject, x, y, *_ in table.values.tolist()}
        objects = tuple(TruthObject(subject, _label(subject, anonymous), at) for subject, at in positions.items())
    path = None
    if _find(folder, f"{prefix}_Groundtruth"):
        _, table = _read_forward(folder, f"{prefix}_Groundtruth", 4, ledger, "ground truth")
        path = _trajectory(table.values[:, 0], table.values[:, 1:])
    return Truth(objects, path) if objects or path else None


def _label(subject: int, anonymous: bool) -> str:
    return "landmark" if anonymous else f"landmark_{subject}"
