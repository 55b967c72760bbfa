"""Correct known shared errors in a log, or in one part of it: odometry, cameras, directions, or stamps of frames."""

from collections.abc import Mapping
from dataclasses import replace
from functools import lru_cache

import numpy as np

from objslam.core.arrays import Floats
from objslam.core.calibration import AXES, LENS
from objslam.core.geometry import lengths, make_pose
from objslam.core.rotation import rotation_from_vector
from objslam.core.trajectory import Trajectory
from objslam.core.types import CameraLog, Images, Log
from objslam.frontend.corrected_odometry import corrected_odometry
from objslam.frontend.surface_ranges import corrected_ranges

_SQUEEZED = 1e-3
"""A clock offset may move frames beyond an end of the path. Their stamps are then squeezed into this time (s) next to that
end. A larger value moves more frames. With a smaller value, stamps of fast cameras become equal, because float64 resolves
Unix time to 0.2 us."""
_AHEAD = np.array([[0.0, 0.0, 1.0]])  # The direction along which depths are measured, in the camera frame.


def take_out(log: Log, error: Mapping[str, float], *, stay: bool = False) -> Log:
    """Return the log corrected by known errors. Its odometry, its cameras, and the stamps and depths of its frames are
    corrected.

    error: the value of each error by its name, as in `Calibration`. An error that is absent is 0. stay: whether a clock
    offset leaves frames on the path (see `later`). If it is False, the offset may move frames beyond an end of the path.
    """
    path, odometry = log.robot_path if stay else None, log.odometry
    if odometry is not None:
        odometry = corrected_odometry(odometry, error)
    cameras = tuple(corrected_camera(one, error, path) for one in log.cameras)
    return replace(log, odometry=odometry, cameras=cameras)


def corrected_mount(base_T_camera: Floats, error: Mapping[str, float], name: str) -> Floats:
    """Return poses base_T_camera (..., 4, 4), corrected by the errors of a camera: turned about the axes of base and moved
    along them.

    name: the name of the camera. error: the turns (rad) and the moves (m) by name.
    """
    turn = _turn(*(float(error.get(f"{name}.{axis}", 0.0)) for axis in AXES))
    move = np.array([error.get(f"{name}.{axis}", 0.0) for axis in "xyz"])
    return make_pose(turn @ base_T_camera[..., :3, :3], base_T_camera[..., :3, 3] + move)


@lru_cache(maxsize=64)
def _turn(roll: float, tilt: float, yaw: float) -> Floats:
    """Return the rotation (3, 3) by the errors `AXES`, rad. The result is cached, because derivatives by other errors need
    the same rotation many times."""
    turn = rotation_from_vector(np.array([roll, tilt, yaw]))
    turn.setflags(write=False)  # All callers share this array.
    return turn


def lens_errors(error: Mapping[str, float], name: str) -> tuple[float, float, float]:
    """Return the errors `LENS` of the camera with this name."""
    focal, cx, cy = (error.get(f"{name}.{one}", 0.0) for one in LENS)
    return focal, cx, cy


def inverse_lens(errors: tuple[float, float, float]) -> tuple[float, float, float]:
    """Return the errors `LENS` whose correction undoes the correction of the given errors."""
    longer = 1 + errors[0]
    return 1 / longer - 1, -errors[1] / longer, -errors[2] / longer


def refocused(directions: Floats, errors: Floats | tuple[float, float, float]) -> tuple[Floats, Floats]:
    """Return unit directions (..., R, 3), corrected by the errors `LENS` of a camera matrix, and their factors (..., R).

    The factors are on the standard deviations of the directions. The correction is a linear map M and a projection onto the
    unit sphere. It multiplies areas on the sphere by det M / |M d|^3 at direction d, and standard deviations by the root of
    this factor. Towards the edge of an image, angles change by less than in its middle. With one factor for all directions,
    noise at the edge would favour a shorter focal length.

    directions: (R, 3) unit. errors: (..., R, 3) of each direction, or (3,) of all.
    """
    (focal, cx, cy), (x, y, z) = np.moveaxis(np.asarray(errors), -1, 0), directions.T
    longer = np.stack([x - cx * z, y - cy * z, (1 + focal) * z], axis=-1)
    length = lengths(longer)
    return longer / length[..., None], np.sqrt((1 + focal) / length) / length


def later(stamps: Floats, clock: float, path: Trajectory | None) -> Floats:
    """Return stamps (N,), s, plus an offset `clock`, s. A stamp that was on the path stays on the path, and the order of the
    stamps stays.

    Stamps that the offset moves beyond an end of the path are squeezed into the millisecond of the path next to that end.
    The pose there is nearly the pose at the end. All streams of a camera move alike, so an image and its boxes keep one
    stamp. Without a path, the offset is only added.
    """
    moved = stamps + clock
    if clock == 0 or path is None:
        return moved
    begin, end = float(path.stamps[0]), float(path.stamps[-1])
    squeezed = min(_SQUEEZED, (end - begin) / 2)
    if clock > 0:
        rest, beyond = end - squeezed, moved > end - squeezed
        inside = rest + squeezed * (moved - rest) / (squeezed + clock)
    else:
        rest, beyond = begin + squeezed, moved < begin + squeezed
        inside = rest - squeezed * (rest - moved) / (squeezed - clock)
    on_path = (stamps >= begin) & (stamps <= end)
    return np.where(on_path & beyond, np.clip(inside, begin, end), moved)


def corrected_camera(one: CameraLog, error: Mapping[str, float], path: Trajectory | None = None) -> CameraLog:
    """Return a camera and its data, corrected by the errors. path: the path on which its stamps stay (see `later`)."""
    camera, name = one.camera, one.camera.name
    clock, (focal, cx, cy) = error.get(f"{name}.clock", 0.0), lens_errors(error, name)
    fx, fy = camera.matrix[0, 0], camera.matrix[1, 1]
    longer = 1 + error.get("range_scale", 0.0)
    corrected = replace(
        camera,
        base_T_camera=corrected_mount(camera.base_T_camera, error, name),
        matrix=camera.matrix + np.array([[focal * fx, 0, cx * fx], [0, focal * fy, cy * fy], [0, 0, 0]]),
        depth_scale=camera.depth_scale / longer,
    )

    def moved(images: Images | None) -> Images | None:
        return None if images is None else replace(images, stamps=later(images.stamps, clock, path))

    found = one.detections
    if found is not None:
        depths = corrected_ranges(error, found.depths, _AHEAD, np.array(longer))
        found = replace(found, frame_stamps=later(found.frame_stamps, clock, path), depths=depths)
    mount = None if one.mount is None else Trajectory(one.mount.stamps, corrected_mount(one.mount.poses, error, name))
    return CameraLog(corrected, found, moved(one.rgb), moved(one.depth), mount)
