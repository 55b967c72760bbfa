"""Collects the keyframes and rays of a session in the form that offline mapping takes."""

from dataclasses import dataclass, replace

import numpy as np

from objslam.core.arrays import Bools, Floats, Ints
from objslam.core.noise import range_noise
from objslam.core.statistics import WHITE
from objslam.core.trajectory import Trajectory
from objslam.core.types import Association, CameraLog, Keyframes, Log, Rays
from objslam.errors import ObjslamError
from objslam.frontend.boxes.robot_parts import ROBOT_PARTS
from objslam.frontend.boxes.second_labels import SECOND_LABELS
from objslam.frontend.corrected_log import inverse_lens, lens_errors, refocused
from objslam.frontend.keyframes import UNCOVERED
from objslam.frontend.known_errors import shared_errors
from objslam.frontend.localization.measured_poses import with_measurements
from objslam.frontend.shared_errors import SharedErrors
from objslam.frontend.surface_ranges import measured_ranges, range_factors
from objslam.live.calibration.covered_keyframes import at_the_end, into_frame, while_running
from objslam.live.mapper.state import MapState
from objslam.mapping.solution import seen_something


@dataclass(frozen=True)
class Collected:
    """The data of a session in the form of offline mapping.

    keyframes, rays: as measured, with the keyframes in time order. keyframe_ids: (K,) the session's ids of the keyframes.
    numbers: (R,) the session's numbers of the rays. association: the object of each ray. ids: (N,) the session's ids of the
    objects. map_T_camera: (K, 4, 4) and positions: (N, 3), m, are the session's estimate. log: the paths and cameras.
    errors: gives the keyframes and rays for any values of the shared errors, or is None if neither errors nor noise are
    estimated. theta: (P,) the present values of the errors, None without `errors`. An error that the session knows and does
    not estimate is already corrected in keyframes, rays and log.
    """

    keyframes: Keyframes
    keyframe_ids: Ints
    rays: Rays
    numbers: Ints
    association: Association
    ids: Ints
    map_T_camera: Floats
    positions: Floats
    log: Log
    errors: SharedErrors | None
    theta: Floats | None


def collect(m: MapState, name: str, running: bool = False) -> Collected:
    """Collect the keyframes, the rays, the association and the estimate of a session. name: the name of the log.

    Keyframes that an existing localisation does not cover are left out, as in offline mapping. running: whether the session
    goes on. If it has ended, the keyframes that are left out are counted with their boxes, and the odometry continues the
    localisation. Landmarks and tracks with enough rays become objects.
    """
    m.graph.refresh()
    k, r = m.keyframes, m.rays
    order = m.time_order()
    covered = while_running(m, order) if running else at_the_end(m, order)
    off = order[~covered.mask]
    if len(off) and not running:
        boxes, where = int(np.isin(r.keyframe, k.id[off]).sum()), f"stamp {k.stamp[off[0]]:.3f}"
        m.counters.drop("keyframes that the localisation does not cover", where, len(off))
        m.counters.drop(UNCOVERED, where, boxes)
    moved = np.eye(4) if running else into_frame(m, order, covered)
    order = order[covered.mask]
    number = np.full(int(k.id.max(initial=-1)) + 1, -1, dtype=np.int64)
    number[k.id[order]] = np.arange(len(order))
    owner, label, place = _owners(m)
    at = number[r.keyframe]
    rows = np.flatnonzero(at >= 0)
    part = _of_robot_parts(m, rows)
    if not running and part.any():
        m.counters.drop(ROBOT_PARTS, f"stamp {k.stamp[order[at[rows[part]].min()]]:.3f}", int(part.sum()))
    rows = rows[~part]
    second = _second_labels(m, rows)
    if not running and second.any():
        m.counters.drop(SECOND_LABELS, None, int(second.sum()))
    rows = rows[~second]
    rows = rows[np.argsort(at[rows], kind="stable")]
    poses = m.graph.poses(k.id[order])
    kept = np.unique(at[rows])
    measured = replace(as_measured(m, order), map_T_base=covered.map_T_base[covered.mask])
    keyframes, rays = seen_something(measured, rays_as_measured(m, rows, at[rows]))
    owners, index = np.unique(owner[rows], return_inverse=True)
    objects = owners[owners >= 0]
    association = Association(index - (len(owners) - len(objects)), label[objects])
    log = replace(recorded_log(m, name, keyframes), localization=covered.localization)
    if covered.measured is not None:
        keyframes = with_measurements(keyframes, log, covered.measured, m.given)
    errors = _shared_errors(m, log, keyframes, rays)
    held = {n: value for n, value in m.errors.items() if errors is None or n not in errors.names}
    if held and len(rays):
        values = np.array(list(held.values()))
        known = SharedErrors(log, keyframes, rays, m.given, tuple(held), values, np.eye(len(held)))
        keyframes, rays, _ = known.at(values)
        log = known.corrected_log(values)
        errors = None if errors is None else replace(errors, log=log, keyframes=keyframes, rays=rays)
    theta = None if errors is None else corrections(m, errors)
    numbers, estimate = r.number[rows], (moved @ poses[kept], place[objects] @ moved[:3, :3].T + moved[:3, 3])
    return Collected(keyframes, k.id[order[kept]], rays, numbers, association, objects, *estimate, log, errors, theta)


def _of_robot_parts(m: MapState, rows: Ints) -> Bools:
    """Return which rays in these rows (R,) show parts of the robot that the session only recognised later."""
    part, camera = np.zeros(len(rows), dtype=bool), m.camera_of_rays(rows)
    for number, finder in m.robot_parts.items():
        mine = np.flatnonzero(camera == number)
        part[mine] = finder.are_parts(m.rays.box[rows[mine]], m.rays.label[rows[mine]])
    return part


def _second_labels(m: MapState, rows: Ints) -> Bools:
    """Return which rays in these rows (R,) have second labels that the session only recognised later."""
    second = np.zeros(len(rows), dtype=bool)
    if not m.given.rays.second_labels:
        return second
    told = np.flatnonzero(np.array([c.sees_size for c in m.cameras], dtype=bool)[m.camera_of_rays(rows)])
    r, some = m.rays, rows[told]
    gone, _ = m.second_labels.second_boxes(r.box[some], r.keyframe[some], r.label[some], r.score[some])
    second[told[gone]] = True
    return second


def _shared_errors(m: MapState, log: Log, keyframes: Keyframes, rays: Rays) -> SharedErrors | None:
    if not len(rays):
        return None
    try:
        return shared_errors(log, keyframes, rays, m.given)
    except ObjslamError as error:  # The calibration file has changed since the session began.
        m.counters.ledger.warn(f"the shared errors are not estimated: {error}")
        return None


def corrections(m: MapState, errors: SharedErrors) -> Floats:
    """Return the present values (P,) of the errors. An error that the session does not correct yet gets its prior mean."""
    return np.array([m.errors.get(n, mean) for n, mean in zip(errors.names, errors.mean.tolist(), strict=True)])


def as_measured(m: MapState, rows: Ints) -> Keyframes:
    """Return the keyframes in these rows (n,), with their stamps and mounts as received, and the noise of the settings."""
    some = replace(m.keyframe_arrays(rows), stamps=m.keyframes.sent[rows], base_T_camera=m.keyframes.mount[rows])
    return replace(some, pose_noise=(1.0, 1.0), lasting=(WHITE, WHITE))


def rays_as_measured(m: MapState, rows: Ints, keyframe: Ints) -> Rays:
    """Return the rays in these rows (R,) without corrections. keyframe: (R,) index of each ray's keyframe."""
    longer = range_factors(m.errors, m.half_widths(rows))
    rays = offline_rays(m, rows, keyframe)
    direction, reach = rays.direction.copy(), measured_ranges(m.errors, rays.range, rays.direction, longer)
    for number, camera in enumerate(m.cameras):
        mine = m.camera_of_rays(rows) == number
        direction[mine], _ = refocused(direction[mine], inverse_lens(lens_errors(m.errors, camera.name)))
    return replace(rays, direction=direction, range=reach, range_sigma=rays.range_sigma / longer)


def offline_rays(m: MapState, rows: Ints, keyframe: Ints) -> Rays:
    """Return the rays in these rows (R,), corrected, as `Rays`. keyframe: (R,) index of each ray's keyframe."""
    names = ("direction", "sigma", "range", "range_sigma", "label", "score", "box")
    columns = {name: getattr(m.rays, name)[rows] for name in names}
    _, bias = range_noise(columns["range"], m.half_widths(rows), m.camera_of_rays(rows), m.sent_cameras, m.given)
    return Rays(keyframe=keyframe, **columns, range_bias=bias, track_id=m.rays.track[rows], label_names=tuple(m.labels))


def recorded_log(m: MapState, name: str, keyframes: Keyframes) -> Log:
    """Return the paths and cameras of a session as received, without its detections.

    keyframes: as measured. They give the mounts of cameras that move on the robot.
    """
    return Log(
        name=name,
        cameras=tuple(CameraLog(camera, mount=_mount(keyframes, number)) for number, camera in enumerate(m.sent_cameras)),
        odometry=m.course.driven.trajectory(),
        localization=m.course.localized.trajectory(),
    )


def _mount(keyframes: Keyframes, camera: int) -> Trajectory | None:
    """Return base_T_camera over time, or None if the camera did not move on the robot."""
    mine = np.flatnonzero(keyframes.camera == camera)
    mounts = keyframes.base_T_camera[mine]
    if not len(mine) or (mounts == mounts[0]).all():
        return None
    stamps, first = np.unique(keyframes.stamps[mine], return_index=True)
    return Trajectory(stamps, mounts[first])


def _owners(m: MapState) -> tuple[Ints, Ints, Floats]:
    """Return the object id (R,) of each ray, -1 if it has none, and labels (N,) and positions (N, 3) indexed by object id.

    A landmark keeps its id. A track with enough rays gets an id above the ids of the landmarks.
    """
    landmarks, rays = m.landmarks, m.rays
    owner = rays.owner.copy()
    first = int(landmarks.id.max(initial=-1)) + 1
    enough = [track for track in m.tracks if len(track.rays) >= m.settings.live.min_rays]
    label = np.zeros(first + len(enough), dtype=np.int64)
    label[landmarks.id] = landmarks.label
    place = np.zeros((len(label), 3))
    place[landmarks.id] = landmarks.position
    for i, track in enumerate(enough, first):
        owner[np.searchsorted(rays.number, track.numbers())] = i
        label[i], place[i] = track.label, track.position
    return owner, label, place
