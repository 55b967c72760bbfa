"""Matching boxes to known landmarks: the best choice by enumeration, gates by sampling."""

import tracemalloc
from dataclasses import replace
from itertools import product

import numpy as np
import pytest
from association_scenes import watch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import linear_sum_assignment

from objslam.association.gating import Edges, best_assignment, gate_limit, gated_edges, tangent_basis, track_bonus
from objslam.association.landmarks import Landmarks
from objslam.association.nearest_neighbour import assign
from objslam.association.observations import MIN_DEPTH, Observations, PosedRays, observe
from objslam.core.geometry import exp_se3, lift_se2


def side_by_side(count=40, **more):
    """Two points passed by at 2 m."""
    poses = lift_se2(np.column_stack([np.zeros(count), np.linspace(-1, 1, count), np.zeros(count)]))
    return watch(np.array([[2.0, 0.3, 0.3], [2.2, -0.4, 0.4]]), poses, **more)


def known(scene, sigma=0.01):
    return {
        "positions": scene.points,
        "covariances": np.tile(np.eye(3) * sigma**2, (len(scene.points), 1, 1)),
        "accepts": np.ones((len(scene.points), len(scene.rays.label_names)), dtype=bool),
        "map_T_camera": scene.keyframes.map_T_camera,
        "sigma": scene.rays.sigma,
    }


def edges_of(ray, landmark, cost):
    zeros = np.zeros(len(ray))
    return Edges(np.array(ray), np.array(landmark), zeros, zeros, np.array(cost, dtype=float))


def total(chosen, costs, unmatched):
    return sum(unmatched if j < 0 else costs[i, j] for i, j in enumerate(chosen))


@given(st.integers(0, 10_000), st.integers(1, 4), st.integers(1, 3))
@settings(max_examples=80)
def test_the_choice_is_the_best_of_all_choices(seed, rays, landmarks):
    rng = np.random.default_rng(seed)
    frame = np.sort(rng.integers(0, 2, rays))
    costs = np.where(rng.random((rays, landmarks)) < 0.7, rng.uniform(0, 12, (rays, landmarks)), np.inf)
    i, j = np.nonzero(np.isfinite(costs))
    chosen = best_assignment(edges_of(i, j, costs[i, j]), costs[i, j], frame, 10.0)
    best = np.inf
    for option in product(range(-1, landmarks), repeat=rays):
        used = [(frame[r], o) for r, o in enumerate(option) if o >= 0]
        if len(set(used)) == len(used):
            best = min(best, total(option, costs, 10.0))
    used = [(frame[r], o) for r, o in enumerate(chosen) if o >= 0]
    assert len(set(used)) == len(used)
    np.testing.assert_allclose(total(chosen, costs, 10.0), best)


@pytest.mark.parametrize("together", [1, 20, 1 << 10])
@pytest.mark.parametrize("seed", range(5))
def test_the_choice_in_many_frames_is_the_best_of_each_frame(seed, together, monkeypatch):
    """However many parts of frames are solved in one call."""
    monkeypatch.setattr("objslam.association.gating._TOGETHER", together)
    rng = np.random.default_rng(seed)
    costs = np.where(rng.random((600, 50)) < 0.1, rng.uniform(0, 12, (600, 50)), np.inf)
    ray, landmark = np.nonzero(np.isfinite(costs))
    frame = np.repeat(np.arange(10), 60)
    chosen = best_assignment(edges_of(ray, landmark, costs[ray, landmark]), costs[ray, landmark], frame, 10.0)
    for of in frame == np.arange(10)[:, None]:
        gain = np.maximum(10.0 - costs[of], 0.0)
        row, column = linear_sum_assignment(gain, maximize=True)
        best = np.full(of.sum(), -1)
        best[row] = np.where(gain[row, column] > 0, column, -1)
        np.testing.assert_array_equal(chosen[of], best)
        assert 0 < (best >= 0).sum() < of.sum()


def test_a_frame_of_10_000_boxes_that_all_compete_needs_no_table_of_them():
    count = 10_000
    ray, landmark = np.repeat(np.arange(count), 2), np.repeat(np.arange(count), 2)
    landmark[1::2] = (landmark[1::2] + 1) % count
    cost = np.tile([1.0, 5.0], count)
    tracemalloc.start()
    chosen = best_assignment(edges_of(ray, landmark, cost), cost, np.zeros(count, dtype=np.int64), 10.0)
    most = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    np.testing.assert_array_equal(chosen, np.arange(count))
    assert most < 50e6  # bytes; a table would take 800e6


def test_boxes_go_to_their_landmarks():
    scene = side_by_side()
    owner = assign(scene.rays, **known(scene))
    assert (owner == scene.whose).mean() > 0.99


def test_a_gate_lets_the_share_through_that_it_should():
    scene = side_by_side(2000)
    for share in (0.9, 0.99):
        owner = assign(scene.rays, **known(scene, 1e-6), gate=share)
        assert abs((owner >= 0).mean() - share) < 4 * np.sqrt(share * (1 - share) / len(scene.rays))


def test_one_box_a_landmark_and_frame():
    scene = side_by_side()
    twice = replace(
        scene.rays, **{k: np.repeat(v, 2, axis=0) for k, v in vars(scene.rays).items() if isinstance(v, np.ndarray)}
    )
    owner = assign(twice, **{**known(scene), "sigma": twice.sigma})
    assert (owner >= 0).sum() == len(scene.rays)
    _, count = np.unique(np.stack([twice.keyframe, owner])[:, owner >= 0], axis=1, return_counts=True)
    assert count.max() == 1


def test_only_labels_that_a_landmark_may_have():
    scene = side_by_side()
    accepts = np.array([[True], [False]])
    assert set(assign(scene.rays, **{**known(scene), "accepts": accepts})) == {-1, 0}


def test_landmarks_without_a_position_are_left_out():
    scene = side_by_side()
    positions = scene.points.copy()
    positions[0] = np.nan
    owner = assign(scene.rays, **{**known(scene), "positions": positions})
    assert set(owner[scene.whose == 0]) == {-1}
    assert (owner[scene.whose == 1] == 1).mean() > 0.99
    nobody = assign(scene.rays, **{**known(scene), "positions": np.full((2, 3), np.nan)})
    assert (nobody == -1).all()


def test_no_landmarks_and_no_rays():
    scene = side_by_side()
    arguments = known(scene)
    nothing = {"positions": np.zeros((0, 3)), "covariances": np.zeros((0, 3, 3)), "accepts": np.zeros((0, 1), dtype=bool)}
    assert (assign(scene.rays, **{**arguments, **nothing}) == -1).all()
    few = scene.rays.take(np.zeros(0, dtype=np.int64))
    assert assign(few, **{**arguments, "sigma": few.sigma}).shape == (0,)


def test_a_range_tells_which_of_two_in_line():
    count = 30
    poses = np.broadcast_to(np.eye(4), (count, 4, 4)).copy()
    scene = watch(np.array([[1.5, 0.0, 0.3], [3.0, 0.0, 0.3]]), poses)
    distance = np.linalg.norm(scene.points - scene.keyframes.map_T_camera[0, :3, 3], axis=1)
    alone = scene.rays.keyframe % 2 == scene.whose  # one box a frame
    rays = scene.rays.take(alone)
    ranged = replace(rays, range=distance[scene.whose[alone]], range_sigma=np.full(len(rays), 0.05))
    arguments = {**known(scene), "sigma": rays.sigma}
    np.testing.assert_array_equal(assign(ranged, **arguments), scene.whose[alone])


@pytest.mark.parametrize("wrong", [0.01, 50.0, np.nan, np.inf])
def test_a_wrong_range_breaks_nothing(wrong):
    scene = side_by_side()
    rays = replace(scene.rays, range=np.full(len(scene.rays), wrong), range_sigma=np.full(len(scene.rays), 0.05))
    np.testing.assert_array_equal(assign(rays, **known(scene)), assign(scene.rays, **known(scene)))


def test_pose_covariance_opens_the_gate_to_what_poses_do():
    scene = side_by_side()
    rng = np.random.default_rng(0)
    noise = np.array([0.02] * 3 + [0.05] * 3)
    moved = scene.keyframes.map_T_camera @ exp_se3(rng.normal(0, noise, (len(scene.keyframes), 6)))
    arguments = {**known(scene), "map_T_camera": moved}
    without = assign(scene.rays, **arguments)
    within = assign(scene.rays, **arguments, pose_covariance=np.tile(np.diag(noise**2), (len(moved), 1, 1)))
    assert (without == scene.whose).mean() < 0.3
    assert (within == scene.whose).mean() > 0.97


def test_the_innovation_is_what_sampling_says():
    """Squared deviations, with noise in pixel, landmark and camera, are chi-squared with 2 degrees of freedom."""
    rng = np.random.default_rng(1)
    count = 4000
    scene = watch(np.array([[2.0, 0.2, 0.5]]), np.broadcast_to(np.eye(4), (count, 4, 4)).copy())
    square = rng.normal(0, 0.02, (3, 3))
    covariance = square @ square.T + 1e-5 * np.eye(3)
    pose = np.diag(np.array([0.01, 0.02, 0.015, 0.02, 0.03, 0.01]) ** 2)
    twist = rng.multivariate_normal(np.zeros(6), pose, count)
    frames = replace(scene.keyframes, base_T_camera=scene.keyframes.base_T_camera @ exp_se3(twist))
    obs, ray, _ = observe(PosedRays(scene.rays, frames, scene.cameras, frames.map_T_camera, scene.rays.sigma))
    place = scene.points[0] + rng.multivariate_normal(np.zeros(3), covariance)
    turn = np.zeros((count, 6, 6))
    turn[:, :3, :3] = turn[:, 3:, 3:] = frames.map_T_camera[:, :3, :3]
    in_map = (turn @ pose @ np.swapaxes(turn, 1, 2))[scene.rays.keyframe[ray]]
    deviations = []
    for _ in range(40):  # all boxes share one draw of the landmark, so it is drawn 40 times
        place = scene.points[0] + rng.multivariate_normal(np.zeros(3), covariance)
        landmark = Landmarks(place[None], covariance[None], np.ones(1), np.ones((1, 1), dtype=bool))
        deviations.append(gated_edges(obs, landmark, 1e6, in_map).deviation)
    assert abs(np.mean(deviations) - 2.0) < 0.25


@pytest.mark.parametrize("uncertain", ["rays", "landmarks", "poses"])
def test_matches_within_the_gate_are_those_of_all_pairs(uncertain):
    """So many pairs that a fast bound excludes most of them, against each pair alone."""
    rng = np.random.default_rng(3)
    rays, count, labels, gate = 300, 30, 3, 9.0
    points = rng.uniform(-4, 4, (count, 3))
    origin, seen = rng.uniform(-4, 4, (rays, 3)) + 100.0, rng.integers(count, size=rays)
    direction = points[seen] + 100.0 - origin + rng.normal(0, 0.1, (rays, 3))
    direction *= rng.choice([-1, 1, 1, 1], (rays, 1)) / np.linalg.norm(direction, axis=1, keepdims=True)
    nan, label = np.full(rays, np.nan), rng.integers(labels, size=rays)
    obs = Observations.of_lines(origin, direction, rng.uniform(0.005, 0.03, rays), nan, nan, label)
    obs = replace(obs, position_sigma=0.02)
    square = rng.normal(0, 0.05, (count, 3, 3)) if uncertain != "rays" else np.zeros((count, 3, 3))
    accepts = rng.random((count, labels)) < 0.6
    landmarks = Landmarks(points + 100.0, square @ square.mT, rng.uniform(1, 3, count), accepts)
    turn = rng.normal(0, 0.02, (rays, 6, 6))
    pose = turn @ turn.mT if uncertain == "poses" else None
    edges = gated_edges(obs, landmarks, gate, pose)
    found = {(i, j): (a, b) for i, j, a, b in zip(edges.ray, edges.landmark, edges.deviation, edges.vague, strict=True)}
    expected = {}
    for i, j in product(range(rays), range(count)):
        to = landmarks.position[j] - origin[i]
        if not accepts[j, label[i]] or to @ direction[i] <= MIN_DEPTH:
            continue
        covariance = landmarks.covariance[j]
        if pose is not None:
            jacobian = np.hstack([np.cross(np.eye(3), to), -np.eye(3)])  # Turns by a and moves by b: to x a - b.
            covariance = covariance + jacobian @ pose[i] @ jacobian.T
        across = np.linalg.svd(direction[i][None])[2][1:]
        own = landmarks.noise[j] ** 2 * (obs.sigma[i] ** 2 * (to @ to) + obs.position_sigma**2)
        spread = across @ covariance @ across.T + own * np.eye(2)
        squared = across @ to @ np.linalg.solve(spread, across @ to)
        if squared <= gate:
            expected[i, j] = squared, np.log(np.linalg.det(spread) / own**2)
    assert len(expected) > 100
    assert list(found) == sorted(expected)
    np.testing.assert_allclose(
        [found[pair] for pair in sorted(expected)], [expected[p] for p in sorted(expected)], atol=1e-8
    )


def test_axes_across_a_direction():
    rng = np.random.default_rng(0)
    n = np.concatenate([rng.normal(size=(50, 3)), np.eye(3), -np.eye(3)])
    n /= np.linalg.norm(n, axis=1, keepdims=True)
    frame = np.concatenate([tangent_basis(n), n[:, None]], axis=1)
    np.testing.assert_allclose(frame @ np.swapaxes(frame, 1, 2), np.tile(np.eye(3), (len(n), 1, 1)), atol=1e-12)


def test_a_track_counts_where_most_of_it_is_elsewhere():
    track = np.array([5, 5, 5, 5, 7, 7, -1])
    matched = np.array([0, 0, 0, 1, 1, -1, 0])
    ray = np.repeat(np.arange(7), 2)
    edges = edges_of(ray, np.tile([0, 1], 7), np.zeros(14))
    bonus = track_bonus(edges, track, matched).reshape(7, 2) > 0
    assert bonus[:4].tolist() == [[True, False]] * 4  # the fourth too, although it is given to the other now
    assert not bonus[4:].any()  # two boxes are no track, and no track is none


def test_gate_limit_is_the_quantile_of_chi_squared():
    from scipy.stats import chi2

    np.testing.assert_allclose([gate_limit(p) for p in (0.5, 0.9, 0.999)], chi2.ppf([0.5, 0.9, 0.999], 2))
