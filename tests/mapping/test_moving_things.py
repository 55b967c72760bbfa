"""Carts that drive around in a room: they become no objects, and things at rest stay."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from more_boxes import with_boxes

from objslam.config import load_settings
from objslam.core.arrays import Floats
from objslam.core.camera import Camera, project
from objslam.core.diagnostics import Ledger
from objslam.core.geometry import interpolate, inverse
from objslam.core.types import Association, Log
from objslam.evaluation.evaluate import evaluate
from objslam.frontend.bearings import build_rays
from objslam.frontend.keyframes import build_keyframes
from objslam.frontend.tracks import tracks_of_rays
from objslam.mapping import pipeline
from objslam.mapping.joint.joint_alternation import JointState
from objslam.mapping.moves import moving_things
from objslam.mapping.moves.moving_things import associated_at_rest, things_at_rest, without_moving_things
from objslam.mapping.solution import seen_something
from objslam.simulation import preset, simulate

_RING = np.linspace(0, 2 * np.pi, 12, endpoint=False)
_CART = np.array([[0.2 * np.cos(a), 0.2 * np.sin(a), z] for a in _RING for z in (0.3, 1.0)])
"""Points on the surface of a cart, 0.4 m wide and 0.7 m high, around its place on the floor."""


def camera_poses(log: Log) -> tuple[Camera, Floats, Floats]:
    """The camera, the stamps of its frames (F,), and the true poses map_T_base (F, 4, 4) of the robot in them."""
    camera, found = log.cameras[0].camera, log.cameras[0].detections
    assert found is not None
    assert log.truth is not None
    assert log.truth.trajectory is not None
    path = log.truth.trajectory
    return camera, found.frame_stamps, interpolate(path.stamps, path.poses, found.frame_stamps, 0.2)[0]


def box_of_cart(camera: Camera, pose: Floats, at: Floats, size: float = 1.0) -> Floats | None:
    """The box (4,) px of a cart at a place (2,) m, None if it is not whole in the image. pose: map_T_base."""
    camera_T_map = inverse(pose @ camera.base_T_camera)
    seen = (_CART * size + np.append(at, 0.0)) @ camera_T_map[:3, :3].T + camera_T_map[:3, 3]
    if seen[:, 2].min() < 0.5:
        return None
    pixels = project(camera, seen)
    low, high = pixels.min(axis=0), pixels.max(axis=0)
    whole = (low > 1).all() and (high < [camera.width - 2, camera.height - 2]).all()
    return np.concatenate([low, high]) if whole else None


def with_carts(log: Log, number: int, seed: int) -> Log:
    """The log with the boxes of carts, which drive straight from one random place to the next at 0.5 to 1.2 m/s."""
    rng = np.random.default_rng(seed)
    camera, stamps, poses = camera_poses(log)
    seconds = np.diff(stamps, prepend=stamps[0])
    middle, reach = poses[:, :2, 3].mean(axis=0), 0.7 * np.ptp(poses[:, :2, 3], axis=0)
    boxes, frames = [], []
    for _ in range(number):
        goals = list(middle + rng.uniform(-0.5, 0.5, (200, 2)) * reach)
        at = goals.pop()
        for frame, pose in enumerate(poses):
            step, away = rng.uniform(0.5, 1.2) * seconds[frame], goals[-1] - at
            if (way := float(np.hypot(*away))) < step:
                goals.pop()
            else:
                at = at + away / way * step
            box = box_of_cart(camera, pose, at)
            if box is not None and rng.random() > 0.1:
                boxes.append(box + rng.normal(0, 1.5, 4))
                frames.append(frame)
    return with_boxes(log, np.array(frames), np.array(boxes), "cart")


@cache
def with_ten_carts(seed: int) -> JointState:
    """A solved drive among ten carts."""
    return solved(with_carts(simulate(preset("rooms", missed=0.1, false=0.0), seed), 10, seed))


@pytest.mark.parametrize("seed", [1, 2])
def test_objects_of_things_that_move_are_dropped(seed: int) -> None:
    before = with_ten_carts(seed)
    after = without_moving_things(before)
    assert len(carts(before)) > 4
    assert len(carts(after)) == 0
    # Their boxes are of no object, and a doubt can say so. All things at rest stay where they are.
    assert before.association is not None
    assert after.association is not None
    gone = (before.association.object >= 0) & (after.association.object < 0)
    assert after.association.refuted is not None
    assert after.association.refuted[gone].all()
    assert (after.rays.label[gone] == after.rays.label_names.index("cart")).mean() > 0.9
    at_rest = places(before)
    assert len(at_rest) == 15
    np.testing.assert_allclose(places(after), at_rest, atol=0.03)


def test_copies_of_things_at_rest_are_merged_when_moving_things_no_longer_bend_the_path() -> None:
    """Each thing has one object in the first half of the drive and another one in the second half."""
    state = with_ten_carts(1)
    assert state.association is not None
    late = state.rays.keyframe > len(state.keyframes) // 2
    owner, count = state.association.object, state.association.count
    both = late & (owner >= 0) & (state.rays.label != state.rays.label_names.index("cart"))
    label = np.append(state.association.label, state.association.label)
    number, inverse_of = np.unique(np.where(both, owner + count, owner), return_inverse=True)
    halves = Association(inverse_of - 1, label[number[1:]])
    bent = state.solve("association", halves, state.solved_poses)
    assert len(places(bent)) > 15
    assert len(places(associated_at_rest(bent))) == 15


def test_rays_that_a_bent_path_rejected_are_taken_back_when_nothing_bends_it() -> None:
    state = with_ten_carts(2)
    assert state.association is not None
    at_rest = state.rays.label != state.rays.label_names.index("cart")
    lost = at_rest & (state.rays.keyframe > len(state.keyframes) // 2)
    few = replace(state.association, object=np.where(lost, -1, state.association.object))
    after = associated_at_rest(state.solve("association", few, state.solved_poses))
    assert after.association is not None
    kept = (after.association.object[lost] >= 0).sum()
    assert kept > 0.95 * (state.association.object[lost] >= 0).sum()
    assert len(carts(after)) == 0
    gone = (state.association.object >= 0) & ~at_rest & (after.association.object < 0)
    assert after.association.refuted is not None
    assert after.association.refuted[gone].all()


@pytest.mark.parametrize("calibrated", [True, False])
@pytest.mark.parametrize("seed", [3])
def test_at_given_poses_things_that_move_are_no_objects_either(seed: int, calibrated: bool) -> None:
    log = with_carts(simulate(preset("rooms", missed=0.1, false=0.0), seed), 10, seed)
    settings = load_settings(None, ("mode=fixed", f"calibration.use={str(calibrated).lower()}", "bodies.use=false"))
    result = pipeline.run(log, settings, Ledger())
    objects = evaluate(result.map, log.truth, align="none").objects
    assert (len(objects.matches), len(objects.missed)) == (15, 0)
    assert len(objects.false) <= 1
    assert {one.label for one in objects.false} <= {"cart"}


def test_a_map_of_things_at_rest_stays_the_same() -> None:
    """Equal things stand close together here, so that a track may pass from one to the next."""
    row = tuple(("cup", (-1.5 + 0.3 * number, 1.0, 0.5)) for number in range(10))
    state = solved(simulate(preset("rooms", placed=row, objects=6, classes=3, missed=0.3, false=0.1), 3))
    assert without_moving_things(state) is state
    assert associated_at_rest(state) is state


@pytest.mark.parametrize("missed", [0.0, 0.2])
def test_tracks_that_join_neighbours_move_nothing_if_all_their_rays_have_objects(missed: float, monkeypatch) -> None:
    """The boxes of a row of large things scatter more than those of other things, and their tracks join neighbours. If their
    things moved, a share of the rays would be of no object."""
    row = tuple(("cup", (-1.5 + 0.3 * number, 1.0, 0.5)) for number in range(10))
    state = solved(simulate(preset("rooms", placed=row, objects=6, classes=3, missed=0.0, false=0.0), 3))
    found, estimate, cup = state.association, state.estimate, state.rays.label_names.index("cup")
    assert found is not None
    assert estimate is not None
    rng = np.random.default_rng(0)
    mine = (state.rays.label == cup) & (found.object >= 0)
    given = tracks_of_rays(state.keyframes, state.rays, state.solved_poses)[0]
    joined = given.copy()  # Each track of the row goes on as that of another thing of the row.
    of_row = np.isin(given, np.unique(given[mine]))
    tracks, place = np.unique(given[of_row], return_inverse=True)
    joined[of_row] = rng.permutation(len(tracks))[place] // 2
    joined[~of_row] += len(tracks)
    track, length = np.unique(joined, return_inverse=True, return_counts=True)[1:]
    monkeypatch.setattr(moving_things, "tracks_of_rays", lambda *_: (track, length))
    scatter = np.where(mine[:, None], rng.normal(0, 2 * state.rays.sigma[:, None], (len(mine), 3)), 0.0)
    direction = state.rays.direction + scatter
    rays = replace(state.rays, direction=direction / np.linalg.norm(direction, axis=1, keepdims=True))
    left = replace(found, object=np.where(mine & (rng.random(len(mine)) < missed), -1, found.object))
    poses = state.keyframes, rays, left, replace(estimate, weight=np.ones(len(mine))), state.solved_poses, state.settings
    cups = left.label == cup
    gone = moving_things._moving(*poses, None)
    assert gone[cups].mean() == (1.0 if missed else 0.0)
    assert not gone[~cups].any()


def with_carts_at_rest(log: Log, places: Floats) -> Log:
    """The log with the boxes of carts at places (N, 2) m. Far away, they are as large as boxes need to show them."""
    camera, _, poses = camera_poses(log)
    rng, boxes, frames = np.random.default_rng(0), [], []
    for place in places:
        size = max(float(np.hypot(*place)) / 40, 1.0)
        seen = [box_of_cart(camera, pose, place, size) for pose in poses]
        boxes += [box + rng.normal(0, 1.5, 4) for box in seen if box is not None]
        frames += [frame for frame, box in enumerate(seen) if box is not None]
    return with_boxes(log, np.array(frames), np.array(boxes), "cart")


def test_boxes_of_far_things_are_of_no_label_that_moves() -> None:
    """The rays to a far thing are parallel, and so they are of no object. A cart nearby, seen in one visit, stays."""
    log = simulate(preset("rooms", missed=0.0, false=0.0), 1)
    far = 3000 * np.array([(1, 0), (0, 1), (-1, 0), (0, -1), (0.7, 0.7), (-0.7, 0.7), (-0.7, -0.7), (0.7, -0.7)])
    state = solved(with_carts_at_rest(log, np.vstack([[(1.0, 0.5)], far])))
    before, estimate = state.association, state.estimate
    assert before is not None
    assert estimate is not None
    cart = before.label == state.rays.label_names.index("cart")
    near = cart & (np.linalg.norm(estimate.positions[:, :2] - [1.0, 0.5], axis=1) < 1.0)
    assert near.sum() == 1
    number = np.append(np.where(cart & ~near, -1, np.cumsum(~cart | near) - 1), -1)
    of_near = number[before.object] == number[np.flatnonzero(near)[0]]
    stamps = state.keyframes.stamps[state.rays.keyframe]
    later = of_near & (stamps > stamps[of_near][0] + 4.0)
    left = Association(np.where(later, -1, number[before.object]), before.label[~cart | near])
    again = state.attempt().solve("association", left, state.solved_poses)
    assert again.estimate is not None
    alone = (left.object < 0) & (state.rays.label == state.rays.label_names.index("cart"))
    assert alone.sum() > 100
    given = again.keyframes, again.rays, left, again.estimate, again.solved_poses, again.settings
    assert things_at_rest(*given) is left


def solved(log: Log) -> JointState:
    """The state after rounds of association and solve that begin at the true poses."""
    settings, ledger = load_settings(None, ("mode=joint", "calibration.use=false")), Ledger()
    frames = build_keyframes(log, settings, ledger)
    rays = build_rays(log, frames, settings, ledger)
    used = seen_something(frames, rays)
    cameras = tuple(one.camera for one in log.cameras)
    state = JointState(frames, rays, *used, cameras, settings, ledger, lambda *_: None, None, None)
    return state.alternated(used[0].map_T_base, None)


def carts(state: JointState) -> np.ndarray:
    """The objects of carts that have rays that agree."""
    assert state.association is not None
    assert state.estimate is not None
    used = np.unique(state.association.object[state.estimate.weight > 0])
    return np.intersect1d(used, np.flatnonzero(state.association.label == state.rays.label_names.index("cart")))


def places(state: JointState) -> np.ndarray:
    """The positions of all other objects, in order."""
    assert state.association is not None
    assert state.estimate is not None
    return state.estimate.positions[state.association.label != state.rays.label_names.index("cart")]
