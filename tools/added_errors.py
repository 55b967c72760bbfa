"""Put errors that all measurements share into a log, as if a robot with a wrong calibration had recorded it."""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from objslam.core.geometry import lift_se2, make_pose, split_se2
from objslam.core.trajectory import Trajectory
from objslam.core.types import Log


def add_shared_errors(log: Log, errors: Mapping[str, float]) -> Log:
    """Return the log as it would be with shared errors of these values, named as in `core.calibration.Calibration`.

    Known names: odometry.scale, odometry.turn_scale, odometry.turn_bias, odometry.turn_per_m, odometry.turn_slip,
    odometry.lateral_scale, range_scale, range_offset, and for each CAMERA the names CAMERA.clock, CAMERA.roll,
    CAMERA.tilt, CAMERA.yaw, CAMERA.focal, CAMERA.cx, CAMERA.cy, CAMERA.x, CAMERA.y and CAMERA.z. The odometry must be
    planar.
    """
    odometry = None if log.odometry is None else _wrong_odometry(log.odometry, errors)
    cameras = []
    for one in log.cameras:
        camera, found = one.camera, one.detections
        kinds = ("roll", "tilt", "yaw", "x", "y", "z", "cx", "cy", "focal")
        *six, cx, cy, focal = (errors.get(f"{camera.name}.{kind}", 0.0) for kind in kinds)
        rotation = Rotation.from_rotvec(six[:3]).inv().as_matrix() @ camera.base_T_camera[:3, :3]
        base_T_camera = make_pose(rotation, camera.base_T_camera[:3, 3] - six[3:])
        matrix = camera.matrix.copy()
        matrix[[0, 1], [0, 1]] /= 1 + focal
        matrix[:2, 2] -= matrix[[0, 1], [0, 1]] * [cx, cy]
        wrong = replace(camera, base_T_camera=base_T_camera, matrix=matrix)
        if found is not None:
            found = replace(
                found,
                frame_stamps=found.frame_stamps - errors.get(f"{camera.name}.clock", 0.0),
                depths=(found.depths - errors.get("range_offset", 0.0)) / (1 + errors.get("range_scale", 0.0)),
            )
        cameras.append(replace(one, camera=wrong, detections=found))
    return replace(log, odometry=odometry, cameras=tuple(cameras))


def _wrong_odometry(odometry: Trajectory, errors: Mapping[str, float]) -> Trajectory:
    """Return the odometry with wrong distances, turns and turn rates. A correction by the same values restores the true
    odometry."""
    names = ("scale", "turn_scale", "turn_bias", "turn_per_m", "turn_slip", "lateral_scale")
    scale, turn_scale, turn_bias, per_m, turn_slip, lateral = (errors.get(f"odometry.{name}", 0.0) for name in names)
    plane, remainder = split_se2(odometry.poses)
    yaw, place = np.unwrap(plane[:, 2]), plane[:, :2]
    # A step is along the mean of the headings at its ends, so errors of these headings turn the step by their mean.
    chord = np.diff(place, axis=0) @ [1, 1j] * np.exp(-0.5j * (yaw[1:] + yaw[:-1]))
    chord /= 1 + scale
    turns = (np.diff(yaw) - turn_bias * np.diff(odometry.stamps) - per_m * chord.real) / (1 + turn_scale)
    said = yaw[0] + np.append(0.0, np.cumsum(turns))
    moves = np.abs(chord) > 0  # A robot that turns on the spot does not slip.
    chord[moves] *= 1 + turn_slip * np.abs(turns[moves]) / np.abs(chord[moves])
    chord.imag /= 1 + lateral
    ways = chord * np.exp(0.5j * (said[1:] + said[:-1]))
    path = place[0] @ [1, 1j] + np.append(0, np.cumsum(ways))
    return Trajectory(odometry.stamps, lift_se2(np.stack([path.real, path.imag, said], axis=1)) @ remainder)
