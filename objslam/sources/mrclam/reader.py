"""Read UTIAS MRCLAM datasets. They have wheel odometry, and ranges and bearings from a camera to landmarks with barcodes.

Source: Leung, Halpern, Barfoot, Liu, The UTIAS multi-robot cooperative localization and mapping dataset, IJRR 30(8), 2011.
The reader converts bearings into pixels of a virtual pinhole camera. This camera is at the origin of base and looks forward.
"""

import re
from pathlib import Path

import numpy as np

from objslam.core.arrays import Floats
from objslam.core.camera import Camera
from objslam.core.diagnostics import Ledger
from objslam.core.geometry import lift_se2, make_pose
from objslam.core.trajectory import Trajectory
from objslam.core.types import CameraLog, Detections, Log, Truth, TruthObject, label_table
from objslam.core.validity import valid_depths, valid_positions, valid_stamps
from objslam.errors import LogError
from objslam.io.text import Table, count_drops, in_order, read_table, reading, select
from objslam.sources.mrclam import MrclamOptions

ROBOTS, LANDMARKS = range(1, 6), range(6, 21)
"""The subject numbers of robots and of landmarks in the dataset."""
_FOCAL = 380.0
"""The focal length of the virtual camera, px. With this value, the noise of the bearings, 0.45 degrees, is 3 px. This is the
default noise of a run."""
_WIDTH, _HEIGHT = 640, 480
"""The image size of the virtual camera, px. The virtual camera sees +-40 degrees. The real camera sees +-30 degrees."""
_MATRIX = np.array([[_FOCAL, 0, _WIDTH / 2], [0, _FOCAL, _HEIGHT / 2], [0, 0, 1.0]])
_FORWARD = make_pose(np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]), np.zeros(3))
"""base_T_camera of the virtual camera. The camera is at the origin of base and looks along base x."""
_FASTEST = 1000.0  # The speed, m/s and rad/s, from which an odometry line is dropped. A larger value keeps damaged lines.
_HALF_BOX = 4.0  # Half the side of a box, px. The dataset has bearings but no boxes, so each bearing gets a small box.
_MARGIN = 6.0  # The least distance of a box centre from the image's edge, px. Boxes nearer to the edge count as cut off.


def is_mrclam(path: Path) -> bool:
    """Return whether the folder is an MRCLAM dataset."""
    return _find(path, "Barcodes") is not None and bool(robots(path))


def robots(folder: Path) -> tuple[int, ...]:
    """Return the numbers of the robots whose odometry is in the folder."""
    found = (re.fullmatch(r"Robot(\d+)_Odometry\.dat(\.gz)?", file.name) for file in folder.glob("Robot*_Odometry.dat*"))
    return tuple(sorted({int(match[1]) for match in found if match}))


def read_mrclam(folder: Path, ledger: Ledger, options: MrclamOptions) -> Log:
    """Return the log of one robot in an MRCLAM folder (files .dat or .dat.gz).

    The odometry starts at the identity and integrates the velocities. Each stamp with a measurement becomes a frame, even if
    all measurements of this stamp are dropped. Depths are the ranges (see `_read_measurements`), or NaN without
    `options.with_range`. Labels are landmark_<subject>. With `options.anonymous`, all labels are "landmark".
    The ground truth has the landmark positions (z = 0) and the robot's path.
    Measurements of other robots, of unknown barcodes, and outside the virtual camera's view are dropped and counted.
    Raises LogError if a file is unusable, no robot is chosen, or the folder lacks the robot.
    """
    robot = options.robot
    with reading(folder):
        if robot not in (found := robots(folder)):
            what = "no robot is chosen" if robot is None else f"there is no robot {robot}"
            numbers = ", ".join(map(str, found)) or "none"
            raise LogError(f"{what}, the folder has: {numbers}", where=str(folder), hint="choose a robot with --robot")
        prefix = f"Robot{robot}"
        detections = _read_measurements(folder, prefix, options, ledger)
        path, table = _read_forward(folder, f"{prefix}_Odometry", 3, ledger, "odometry")
        slow = np.asarray((np.abs(table.values[:, 1:]) < _FASTEST).all(axis=1))
        table = select(table, slow, "odometry line with a speed that no robot reaches", path, ledger)
        if not len(table.lines):
            raise LogError("no usable line: every stamp or speed is invalid", where=str(path))
        stamps, velocities = table.values[:, 0], table.values[:, 1:]
        driven = integrate(stamps, velocities)
        if not valid_positions(driven[:, :2]).all():
            raise LogError("the odometry leads out of range", where=str(path), hint="are stamps in s and speeds in m/s?")
        camera = Camera("camera", _WIDTH, _HEIGHT, _MATRIX, base_T_camera=_FORWARD, sees_size=False)
        return Log(
            name=f"{folder.resolve().name}_robot{robot}",
            cameras=(CameraLog(camera, detections),),
            odometry=_trajectory(stamps, driven),
            truth=_read_truth(folder, prefix, options.anonymous, ledger),
        )


def integrate(stamps: Floats, velocities: Floats) -> Floats:
    """Return x, y (m) and yaw (rad) of a robot at each stamp, (N, 3), from its velocities. The first pose is zero.

    stamps: (N,) s. velocities: (N, 2) forward velocity (m/s) and turn rate (rad/s). Each row is valid until the next stamp,
    so the robot drives exact arcs.
    """
    way, turn = (velocities[:-1] * np.diff(stamps)[:, None]).T
    half = turn / 2
    yaw = np.concatenate([[0.0], np.cumsum(turn)])
    chord = way * np.sinc(half / np.pi)
    steps = np.stack([chord * np.cos(yaw[:-1] + half), chord * np.sin(yaw[:-1] + half)], axis=1)
    return np.column_stack([np.vstack([np.zeros((1, 2)), np.cumsum(steps, axis=0)]), yaw])


def bearing_to_pixel(bearing: Floats) -> Floats:
    """Return the columns (px) of bearings (rad, positive to the left) in the image of the virtual camera."""
    return _WIDTH / 2 - _FOCAL * np.tan(bearing)


def _find(folder: Path, name: str) -> Path | None:
    return next((f for f in (folder / f"{name}.dat", folder / f"{name}.dat.gz") if f.is_file()), None)


def _read(folder: Path, name: str, columns: int, ledger: Ledger, what: str) -> tuple[Path, Table]:
    path = _find(folder, name)
    if path is None:
        raise LogError(f"there is neither {name}.dat nor {name}.dat.gz", where=str(folder))
    return path, read_table(path, columns, ledger, what)


def _read_forward(folder: Path, name: str, columns: int, ledger: Ledger, what: str) -> tuple[Path, Table]:
    """Read a table, and drop the lines whose stamp (the first column) goes back. Stamps may repeat."""
    path, table = _read(folder, name, columns, ledger, what)
    table = select(table, valid_stamps(table.values[:, 0]), f"{what} line with a stamp that is too large", path, ledger)
    forward = in_order(table.values[:, 0], repeats=True)
    return path, select(table, forward, f"{what} line with a stamp that goes back", path, ledger)


def _trajectory(stamps: Floats, xy_yaw: Floats) -> Trajectory:
    first = np.concatenate([[True], np.diff(stamps) > 0])  # Stamps may repeat. A Trajectory has one pose for each stamp.
    return Trajectory(stamps[first], lift_se2(xy_yaw[first]))


def _read_measurements(folder: Path, prefix: str, options: MrclamOptions, ledger: Ledger) -> Detections:
    """Return the measurements as detections. The "range" of the dataset is used as a depth along the optical axis.

    The camera measures the height of a barcode in its image, and this height depends on the depth. This was tested with the
    poses of the motion capture and five robots of MRCLAM 6 and 7. The ranges are shorter than the distances of the landmarks
    by the cosine of the bearing, which is 11 % at 27 degrees. Their errors scatter by 3.4 to 4.5 % if they are taken as
    distances, and by 0.8 to 1.6 % if they are taken as depths.
    """
    _, barcodes = _read(folder, "Barcodes", 2, ledger, "barcode")
    path, table = _read_forward(folder, f"{prefix}_Measurement", 4, ledger, "measurement")
    subjects = (*ROBOTS, *LANDMARKS)
    subject_of = {code: int(subject) for subject, code in barcodes.values.tolist() if subject in subjects}
    stamps, codes, distance, bearing = table.values.T
    subject = np.array([subject_of.get(code, 0) for code in codes.tolist()], dtype=np.int64)
    frame_stamps, frame = np.unique(stamps, return_inverse=True)
    in_view = np.abs(bearing) < np.arctan((_WIDTH / 2 - _MARGIN) / _FOCAL)
    good = np.ones(len(subject), dtype=bool)
    for fine, reason in (
        (subject != 0, "measurement of an unknown barcode"),
        (~np.isin(subject, ROBOTS), "measurement of another robot"),
        (in_view, "measurement with a bearing outside the virtual camera's view"),
    ):
        bad = good & ~fine
        count_drops(reason, int(bad.sum()), (f"{path}:{line}" for line in table.lines[bad]), ledger)
        good &= fine
    depths = distance if options.with_range else np.full(len(subject), np.nan)
    wrong = good & ~(valid_depths(depths) | np.isnan(depths))
    places = (f"{path}:{line}" for line in table.lines[wrong])
    count_drops("range that is not above zero or too large (taken as unknown)", int(wrong.sum()), places, ledger)
    depths = np.where(wrong, np.nan, depths)
    label_names, label = label_table([_label(s, options.anonymous) for s in subject[good].tolist()])
    count = int(good.sum())
    centre = np.column_stack([bearing_to_pixel(bearing[good]), np.full(count, _HEIGHT / 2)])
    boxes, tracks = np.hstack([centre - _HALF_BOX, centre + _HALF_BOX]), np.full(count, -1)
    return Detections(frame_stamps, frame[good], boxes, label, np.ones(count), depths[good], tracks, label_names)


def _read_truth(folder: Path, prefix: str, anonymous: bool, ledger: Ledger) -> Truth | None:
    objects: tuple[TruthObject, ...] = ()
    if _find(folder, "Landmark_Groundtruth"):
        file, table = _read(folder, "Landmark_Groundtruth", 5, ledger, "landmark")
        known = np.isin(table.values[:, 0], LANDMARKS)
        table = select(table, known, "landmark line with a subject that is no landmark", file, ledger)
        near = valid_positions(table.values[:, 1:3])
        table = select(table, near, "landmark line with a position that is too far away", file, ledger)
        positions = {int(subject): np.array([x, y, 0.0]) for subject, x, y, *_ in table.values.tolist()}
        objects = tuple(TruthObject(subject, _label(subject, anonymous), at) for subject, at in positions.items())
    path = None
    if _find(folder, f"{prefix}_Groundtruth"):
        file, table = _read_forward(folder, f"{prefix}_Groundtruth", 4, ledger, "ground truth")
        near = valid_positions(table.values[:, 1:3])
        table = select(table, near, "ground truth line with a position that is too far away", file, ledger)
        path = _trajectory(table.values[:, 0], table.values[:, 1:]) if len(table.lines) else None
    return Truth(objects, path) if objects or path else None


def _label(subject: int, anonymous: bool) -> str:
    return "landmark" if anonymous else f"landmark_{subject}"
