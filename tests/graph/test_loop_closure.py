"""Covariances between two poses of a path against closed forms, and loops that a bent path missed."""

from __future__ import annotations

import gtsam
import numpy as np
import pytest

from objslam.core.geometry import lift_se2
from objslam.graph.loop_closure import (
    _BESIDE,
    POSE_FLOOR,
    Landmarks,
    closed_path,
    find_missed_closures,
    relative_covariances,
)
from objslam.graph.variables import X0


def straight(steps: int) -> tuple[gtsam.Marginals, np.ndarray]:
    """The marginals and the poses (K, 4, 4) of a straight path with steps of 1 m. A step errs by 0.02 m along each axis."""
    poses = lift_se2(np.column_stack([np.arange(steps + 1.0), np.zeros(steps + 1), np.zeros(steps + 1)]))
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    noise = gtsam.noiseModel.Diagonal.Sigmas(np.array([1e-6] * 3 + [0.02] * 3))
    for k, pose in enumerate(poses):
        values.insert(X0 + k, gtsam.Pose3(pose))
        if k:
            step = gtsam.Pose3(np.linalg.inv(poses[k - 1]) @ pose)
            graph.add(gtsam.BetweenFactorPose3(X0 + k - 1, X0 + k, step, noise))
    graph.add(gtsam.PriorFactorPose3(X0, gtsam.Pose3(poses[0]), gtsam.noiseModel.Isotropic.Sigma(6, 1e-3)))
    return gtsam.Marginals(graph, values), poses


class Unsure:
    """Marginals that are indeterminate for one anchor, as a landmark with hardly any parallax makes them."""

    def __init__(self, marginals: gtsam.Marginals, anchor: int) -> None:
        self.marginals, self.anchor = marginals, anchor

    def jointMarginalCovariance(self, keys: list[int]) -> gtsam.JointMarginal:
        if keys[0] == X0 + self.anchor:
            raise RuntimeError("Indeterminate linear system")
        return self.marginals.jointMarginalCovariance(keys)


def test_the_covariance_relative_to_an_anchor_grows_with_the_steps_between():
    marginals, poses = straight(9)
    near, far = (relative_covariances(marginals, poses, [anchor], 9)[0] for anchor in (5, 0))
    assert near[0, 0] == pytest.approx(4 * 0.02**2 + POSE_FLOOR[0] ** 2, rel=1e-3)
    assert far[0, 0] == pytest.approx(9 * 0.02**2 + POSE_FLOOR[0] ** 2, rel=1e-3)


def test_an_anchor_without_a_covariance_leaves_the_others():
    marginals, poses = straight(9)
    every = relative_covariances(marginals, poses, [0, 5], 9)
    left = relative_covariances(Unsure(marginals, 5), poses, [0, 5], 9)
    assert len(left) == len(every) / 2
    np.testing.assert_allclose(left, every[: len(left)])


def two_visits(seed, turn, shift):
    """Eight places, and the same places as a second visit finds them: turned by `turn` (rad) and moved by `shift` (m)."""
    rng = np.random.default_rng(seed)
    places = np.column_stack([rng.uniform(0, 8, (8, 2)), rng.uniform(0, 1.5, 8)])
    moved = places @ gtsam.Rot3.Rz(turn).matrix().T + [*shift, 0.0]
    position = np.concatenate([places, moved]) + rng.normal(0, 0.03, (16, 3))
    owner = np.repeat(np.arange(16), 10)
    landmarks = Landmarks.none().and_also(position, np.tile(0.05**2 * np.eye(3), (16, 1, 1)), np.zeros(16, dtype=np.int64))
    landmarks.see(np.arange(160), owner, np.arange(160), np.arange(161))
    return landmarks, np.tile(np.eye(4), (160, 1, 1))


def test_the_second_visit_is_found_through_a_bend_of_the_path():
    landmarks, path = two_visits(1, np.radians(25), (1.5, -1.0))
    found = find_missed_closures(landmarks, landmarks.first + 4.5, path)
    best = found[0]
    assert dict(zip(best.now.tolist(), best.before.tolist(), strict=True)) == {8 + i: i for i in range(8)}
    moved = landmarks.position[8:] @ best.correction[:3, :3].T + best.correction[:3, 3]
    assert np.abs(moved - landmarks.position[:8]).max() < 0.2
    assert best.evidence == max(closure.evidence for closure in found) > 0
    path = closed_path(best, landmarks, path, np.arange(160.0))
    np.testing.assert_allclose(path[:78], np.tile(np.eye(4), (78, 1, 1)), atol=1e-9)
    np.testing.assert_allclose(path[80:], np.tile(best.correction, (80, 1, 1)), atol=1e-9)


def test_landmarks_that_one_frame_shows_are_no_copies():
    landmarks, path = two_visits(1, np.radians(25), (1.5, -1.0))
    landmarks.together[:] = True
    assert find_missed_closures(landmarks, landmarks.first + 4.5, path) == []


def test_few_landmarks_are_no_loop():
    landmarks, path = two_visits(1, 0.0, (0.0, 0.0))
    middle = np.where(np.arange(16) < 3, landmarks.first, np.nan)
    assert find_missed_closures(landmarks, middle, path) == []


def seen(owner: list[int], keyframe: list[int]) -> Landmarks:
    """Landmarks of rays (R,), which are sorted by keyframe."""
    rays, count = np.array(owner), max(owner) + 1
    landmarks = Landmarks.none().and_also(np.zeros((count, 3)), np.zeros((count, 3, 3)), np.zeros(count, dtype=np.int64))
    first_ray = np.searchsorted(keyframe, np.arange(max(keyframe) + 2))
    landmarks.see(np.array(keyframe), rays, np.arange(len(rays)), first_ray)
    return landmarks


def test_a_landmark_is_expected_from_those_that_a_frame_showed_beside_it():
    """Landmark 0 was beside 1, and 1 beside 2, which is seen last. Nothing was beside landmark 3."""
    landmarks = seen([0, 1, 3, 1, 2, 2], [0, 0, 1, 2, 2, 9])
    turned = landmarks.turned(0.01 * np.arange(10.0), 9)
    np.testing.assert_allclose(turned, [2 * _BESIDE**2, _BESIDE**2, 0.0, 0.08], atol=1e-12)


def test_a_landmark_beside_none_that_was_seen_later_drifts_alone():
    landmarks = seen([0, 1, 1], [2, 2, 3])
    heading = np.array([0.0, 0.0, 0.0, 1e-4, 1e-3, 2e-3])  # Less than the way over landmark 1 adds.
    np.testing.assert_allclose(landmarks.turned(heading, 5), [2e-3, 1.9e-3], atol=1e-12)
    assert landmarks.turned(100 * heading, 5)[0] == pytest.approx(0.19 + _BESIDE**2)


def test_merged_landmarks_have_the_rays_and_frames_of_all():
    landmarks = seen([0, 1, 2, 3, 0, 3], [0, 0, 4, 4, 6, 7])
    merged = landmarks.renumbered(np.array([0, 1, 0, -1]), np.ones((2, 3)))
    assert merged.rays.tolist() == [3, 1]
    assert merged.first.tolist() == [0, 0]
    assert merged.last.tolist() == [6, 0]
    assert merged.together.tolist() == [[True, True], [True, True]]
    assert not merged.compared.any()  # All pairs are compared again.
