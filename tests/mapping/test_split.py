"""Objects that may be two, on a drive along both sides of a wall with signs."""

from dataclasses import replace

import numpy as np
import pytest
from added_errors import add_shared_errors

from objslam.config import load_settings
from objslam.core.arrays import Floats, Ints
from objslam.core.camera import Camera, project
from objslam.core.diagnostics import Ledger
from objslam.core.geometry import lift_se2, make_pose
from objslam.core.trajectory import Trajectory
from objslam.core.types import Association, CameraLog, Detections, Log
from objslam.frontend.bearings import build_rays
from objslam.frontend.keyframes import build_keyframes
from objslam.frontend.known_errors import shared_errors
from objslam.mapping.joint.joint_alternation import JointState
from objslam.mapping.joint.merge_and_split import split_at_gaps
from objslam.mapping.solution import seen_something

BASE_T_CAMERA = make_pose(np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]]), np.array([0.1, 0.0, 1.0]))
WAY = [(0.0, 0.0, 0.0), (9.0, 0.0, 0.0), (9.0, 0.0, np.pi / 2), (9.0, 4.0, np.pi / 2), (9.0, 4.0, np.pi), (0.0, 4.0, np.pi)]


def signs(apart: float) -> tuple[Floats, Floats]:
    """Signs (N, 3) m along two aisles, and their sides (N,) along y. Those on both sides of the wall are `apart` m apart."""
    along = np.arange(2.0, 9.0, 1.7)
    rows = [(-1.6, 1.0), (2.0 - apart / 2, -1.0), (2.0 + apart / 2, 1.0), (5.6, -1.0)]
    place = [
        np.column_stack([along + 0.4 * (k in (0, 3)), np.full(5, y), 1.0 + 0.2 * np.cos(along)])
        for k, (y, _) in enumerate(rows)
    ]
    return np.concatenate(place), np.repeat([side for _, side in rows], 5)


def path_of_two_rounds() -> tuple[Floats, Floats]:
    """Stamps (P,) s and x, y, yaw (P, 3) of two rounds through both aisles."""
    corners = np.array([*WAY, (0.0, 4.0, 1.5 * np.pi), (0.0, 0.0, 1.5 * np.pi), (0.0, 0.0, 2 * np.pi)])
    step = np.diff(corners, axis=0)
    time = np.append(0.0, np.cumsum(np.hypot(step[:, 0], step[:, 1]) / 0.7 + np.abs(step[:, 2]) / 0.8))
    round_ = np.column_stack([np.interp(np.arange(0.0, time[-1], 0.05), time, column) for column in corners.T])
    path = np.concatenate([round_, round_ + np.array([0.0, 0.0, 2 * np.pi])])
    return 0.05 * np.arange(len(path)), path


def drive(apart: float, *, through: bool = False) -> Log:
    """Two rounds through both aisles. The signs on the wall have a label of their own. through: they show to both sides."""
    rng = np.random.default_rng(1)
    at, path = path_of_two_rounds()
    stamps = np.arange(0.5, at[-1], 0.3)
    map_T_camera = lift_se2(np.column_stack([np.interp(stamps, at, column) for column in path.T])) @ BASE_T_CAMERA
    places, sides = signs(apart)
    to = places - map_T_camera[:, None, :3, 3]
    away = np.linalg.norm(to, axis=2)
    local = np.einsum("kji,knj->kni", map_T_camera[:, :3, :3], to)
    camera = Camera("front", 640, 480, np.array([[380.0, 0, 320], [0, 380, 240], [0, 0, 1]]), base_T_camera=BASE_T_CAMERA)
    with np.errstate(all="ignore"):
        pixels = project(camera, local.reshape(-1, 3)).reshape(*local.shape[:2], 2)
    half = 380 * 0.15 / np.maximum(local[..., 2:], 0.1)
    seen = (local[..., 2] > 0.5) & (away < 5) & ((pixels - half > 2) & (pixels + half < [637, 477])).all(axis=2)
    wall = np.abs(places[:, 1] - 2.0) < 1
    seen &= (to[..., 1] * sides < -0.3 * away) | (through & wall & (np.abs(to[..., 1]) > 0.3 * away))
    frame, which = np.nonzero(seen & (rng.random(seen.shape) > 0.1))
    centre = pixels[frame, which] + rng.normal(size=(len(frame), 2))
    box = np.concatenate([centre - half[frame, which], centre + half[frame, which]], axis=1)
    ones, none = np.ones(len(frame)), np.full(len(frame), np.nan)
    found = Detections(stamps, frame, box, wall[which].astype(np.int64), ones, none, which, ("sign", "wall"))
    return Log("aisles", (CameraLog(camera, found),), odometry=Trajectory(at, lift_se2(path)))


def solved(log: Log, object_of: Ints) -> JointState:
    """The state of a log whose signs belong to the objects (N,), which have the label of their signs."""
    settings, ledger = load_settings(None, ("mode=joint", "output.recording=false")), Ledger()
    frames = build_keyframes(log, settings, ledger)
    rays = build_rays(log, frames, settings, ledger)
    mine, mine_rays = seen_something(frames, rays)
    cameras = tuple(one.camera for one in log.cameras)
    errors = shared_errors(log, mine, mine_rays, settings)
    state = JointState(frames, rays, mine, mine_rays, cameras, settings, ledger, lambda *_: None, None, errors)
    _, first, owner = np.unique(object_of[mine_rays.track_id], return_index=True, return_inverse=True)
    label = mine_rays.label[first]
    return state.solve("association", Association(owner, label))


def signs_of(state: JointState) -> list[set[int]]:
    """The signs in each object."""
    held = state.association.object
    return [set(state.rays.track_id[held == j].tolist()) for j in range(state.association.count)]


def test_signs_on_both_sides_of_a_wall_leave_the_objects_that_hold_both():
    """The path is bent until all rays agree with one point for the two signs on both sides."""
    log = add_shared_errors(drive(0.8), {"odometry.turn_scale": -0.06})
    together = np.arange(20)
    together[10:15] = together[5:10]
    bent = solved(log, together)
    assert bent.agree.mean() > 0.95
    assert max(map(len, signs_of(bent))) == 2
    right = bent.split()
    assert sorted(map(min, signs_of(right))) == sorted(set(right.rays.track_id.tolist()))
    assert all(len(one) == 1 for one in signs_of(right))
    turns = right.errors.names.index("odometry.turn_scale")
    assert abs(right.theta[turns] + 0.06) < 0.5 * abs(bent.theta[turns] + 0.06)


def test_a_thing_that_shows_to_both_sides_stays_one_object():
    log = add_shared_errors(drive(0.0, through=True), {"odometry.turn_scale": -0.06})
    one = np.arange(20)
    one[10:15] = one[5:10]
    state = solved(log, one)
    assert state.split().association.count == state.association.count


def test_bundles_merge_again_though_the_boxes_of_each_side_have_an_error_of_their_own():
    """Seen from one side, the boxes of each sign on the wall are 30 % of their size too high or too low."""
    log = drive(0.0, through=True)
    found, path = log.cameras[0].detections, log.odometry
    left = np.interp(found.stamps, path.stamps, path.poses[:, 1, 3]) > 2.0
    found = found.take(np.flatnonzero((left == (found.track_ids >= 10)) | (found.label == 0)))
    odd = found.track_ids % 2 == 1
    high = np.where(odd, 0.3, -0.3) * ((found.track_ids >= 5) & (found.track_ids < 10))
    boxes = found.boxes + (high * (found.boxes[:, 3] - found.boxes[:, 1]))[:, None] * np.array([0.0, 1.0, 0.0, 1.0])
    log = replace(log, cameras=(replace(log.cameras[0], detections=replace(found, boxes=boxes)),))
    two = solved(log, np.arange(20))
    assert two.merged().association.count > 15
    assert two.merged(bundles=True).association.count == 15


@pytest.mark.parametrize(("gap", "objects"), [(5.0, 1), (25.0, 2), (170.0, 2)])
def test_rays_are_split_at_a_gap_in_their_directions(gap, objects):
    angle = np.radians(np.concatenate([np.linspace(0, 40, 30), 40 + gap + np.linspace(0, 10, 12)]))
    direction = np.column_stack([np.cos(angle), np.sin(angle), np.full(42, 0.1)])
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    used = np.ones(42, dtype=bool)
    used[[3, 35]] = False
    shuffled = np.random.default_rng(2).permutation(42)
    found = split_at_gaps(direction[shuffled], Association(np.zeros(42, dtype=np.int64), np.array([4])), used[shuffled], 3)
    assert found.count == objects
    assert (found.label == 4).all()
    assert len(set(found.object[shuffled < 30])) == 1
    assert (found.object[shuffled < 30][0] == found.object[shuffled >= 30]).all() == (objects == 1)


def test_two_rays_beyond_a_gap_are_no_object():
    direction = np.array([[1.0, 0, 0]] * 8 + [[0.0, 1, 0]] * 2)
    one = Association(np.zeros(10, dtype=np.int64), np.zeros(1, dtype=np.int64))
    assert split_at_gaps(direction, one, np.ones(10, dtype=bool), 3).count == 1
    none = replace(one, object=np.full(10, -1))
    assert split_at_gaps(direction, none, np.zeros(10, dtype=bool), 3).count == 1


def test_a_part_of_a_split_object_has_its_labels_and_its_existence():
    direction = np.repeat([[1.0, 0.0, 0.0], [-1.0, 0.0, 0.0]], 10, axis=0)
    one = Association(np.zeros(20, dtype=np.int64), np.array([1]), np.array([[0.2, 0.8]]), np.array([0.9]))
    found = split_at_gaps(direction, one, np.ones(20, dtype=bool), 3)
    assert found.count == 2
    assert found.label_weights.tolist() == [[0.2, 0.8], [0.2, 0.8]]
    assert found.existence.tolist() == [0.9, 0.9]
