"""A stretch of rays laid onto landmarks: the correction comes back, strays and wrong ranges do not matter."""

import numpy as np
import pytest

from objslam.association.correlative_alignment import align
from objslam.core.geometry import inverse, lift_se2
from objslam.core.types import Rays

LANDMARKS = np.array([[4.0, 0.0, 0.0], [4.0, 0.4, 0.0], [4.1, -0.4, 0.2], [3.0, 2.5, 0.0], [3.5, -2.0, 0.0]])
ROBOT_T_CAMERA = np.array([[0.0, 0.0, 1.0, 0.0], [-1.0, 0.0, 0.0, 0.0], [0.0, -1.0, 0.0, 0.3], [0.0, 0.0, 0.0, 1.0]])


def drive(rng, rays_each=1, ranges=True, strays=0):
    """True camera poses of ten keyframes, rays to the landmarks (3 mrad, 3 cm off; the last `strays` to nowhere), whose."""
    path = np.column_stack([np.linspace(0, 0.5, 10), np.linspace(0, 0.1, 10), np.linspace(0, 0.2, 10)])
    poses = lift_se2(path) @ ROBOT_T_CAMERA
    keyframe = np.repeat(np.arange(10), rays_each)
    whose = rng.integers(0, len(LANDMARKS), len(keyframe))
    to = LANDMARKS[whose]
    in_camera = np.einsum("rij,rj->ri", inverse(poses)[keyframe][:, :3, :3], to - poses[keyframe][:, :3, 3])
    distance = np.linalg.norm(in_camera, axis=1)
    direction = in_camera / distance[:, None] + rng.normal(0, 0.003, in_camera.shape)
    if strays:
        direction[-strays:] = rng.normal([0, 0, 2], 1, (strays, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    count = len(keyframe)
    measured = distance + rng.normal(0, 0.03, count) if ranges else np.full(count, np.nan)
    zeros = np.zeros(count, dtype=np.int64)
    rays = Rays(
        keyframe=keyframe,
        direction=direction,
        sigma=np.full(count, 0.004),
        range=measured,
        range_sigma=np.full(count, 0.05),
        range_bias=np.zeros(count),
        label=zeros,
        score=np.ones(count),
        box=np.zeros((count, 4)),
        track_id=zeros - 1,
        label_names=("post",),
    )
    return poses, rays, whose


@pytest.mark.parametrize("ranges", [True, False])
@pytest.mark.parametrize("seed", range(5))
def test_the_correction_of_a_stretch_comes_back(seed, ranges):
    rng = np.random.default_rng(seed)
    poses, rays, whose = drive(rng, rays_each=2, ranges=ranges, strays=3)

    def nearest(rays, at):
        """Which rays have their own landmark nearest."""
        origins, directions = rays.in_map(at)
        to = LANDMARKS - origins[:, None]
        off = np.linalg.norm(np.cross(to, directions[:, None]), axis=2) / np.linalg.norm(to, axis=2)
        return off.argmin(axis=1) == whose

    if ranges:
        rays.range[::7] += 2.0
    # a heading off by as much as neighbouring landmarks are apart: each ray alone would take the wrong one
    off = lift_se2(np.array([0.05, -0.06, 0.09]))
    wrong = off @ poses
    labels = np.zeros(len(LANDMARKS), dtype=np.int64)
    correction = align(rays, LANDMARKS, labels, wrong, wrong[0, :3, 3], np.array([0.1, 0.1, 0.07]), np.ones(len(poses)))
    assert nearest(rays, correction @ wrong)[:-3].mean() > 0.97
    assert nearest(rays, wrong)[:-3].mean() < 0.8
    left = inverse(poses) @ correction @ wrong
    assert np.abs(np.arctan2(left[:, 0, 2], left[:, 2, 2])).max() < 0.03


def test_a_heading_that_drifts_along_the_poses_is_corrected_at_each_pose():
    """One correction for all poses fits only some of their rays."""
    poses, rays, _ = drive(np.random.default_rng(0), rays_each=2)
    share = np.linspace(0, 1, len(poses))
    wrong = lift_se2(share[:, None] * np.array([0.0, 0.0, 0.2])) @ poses
    spread = np.array([0.0, 0.0, 0.1])
    labels, off = np.zeros(len(LANDMARKS), dtype=np.int64), []
    for part in (share, np.ones(len(poses))):
        left = inverse(poses) @ align(rays, LANDMARKS, labels, wrong, np.zeros(3), spread, part) @ wrong
        off.append(np.abs(np.arctan2(left[:, 0, 2], left[:, 2, 2])).max())
    assert off[0] < 0.02
    assert off[1] > 0.05


def test_without_drift_nothing_moves():
    poses, rays, _ = drive(np.random.default_rng(0))
    labels, whole = np.zeros(5, dtype=np.int64), np.ones(len(poses))
    still = align(rays, LANDMARKS + np.array([0.1, 0.1, 0.0]), labels, poses, poses[3, :3, 3], np.zeros(3), whole)
    np.testing.assert_allclose(still, np.broadcast_to(np.eye(4), still.shape), atol=1e-12)


def test_landmarks_of_other_labels_say_nothing():
    poses, rays, _ = drive(np.random.default_rng(0))
    still = align(rays, LANDMARKS, np.ones(5, dtype=np.int64), poses, poses[0, :3, 3], np.full(3, 0.1), np.ones(len(poses)))
    np.testing.assert_allclose(still, np.broadcast_to(np.eye(4), still.shape), atol=1e-12)


@pytest.mark.parametrize("at_once", [300, 30])  # fewer hypotheses, and fewer rays too
def test_what_does_not_fit_into_memory_at_once_is_taken_in_parts(monkeypatch, at_once):
    poses, rays, _ = drive(np.random.default_rng(1), rays_each=2)
    wrong = lift_se2(np.array([0.03, 0.02, 0.05])) @ poses
    spread, whole = np.array([0.1, 0.1, 0.07]), np.ones(len(poses))
    ask = (rays, LANDMARKS, np.zeros(5, dtype=np.int64), wrong, wrong[0, :3, 3], spread, whole)
    whole = align(*ask)
    monkeypatch.setattr("objslam.association.correlative_alignment._AT_ONCE", at_once)
    np.testing.assert_array_equal(align(*ask), whole)
