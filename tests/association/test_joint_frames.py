"""Frames of many maps: exact without noise, as repeated measurements say with it, and steady against a moved object."""

import numpy as np
from association.registration_scenes import SIGMA

from objslam.association.registration.joint_frames import Measured, solve_frames
from objslam.core.geometry import lift_se2


def scene(rng, maps=4, count=15, sigma=SIGMA):
    """Maps that each have two thirds of the objects, each in a frame of its own; the first is the frame of the result."""
    points = np.column_stack([rng.uniform(0, 8, (count, 2)), rng.uniform(0, 2, count)])
    frames = np.array([np.eye(4), *(lift_se2(rng.uniform(-3, 3, 3)) for _ in range(maps - 1))])
    frames[1:, 2, 3] = rng.uniform(-1, 1, maps - 1)
    pairs = [(s, k) for s in range(maps) for k in np.sort(rng.choice(count, 2 * count // 3, replace=False)).tolist()]
    map_, object_ = np.array(pairs).T
    numbers, object_ = np.unique(object_, return_inverse=True)
    back = np.linalg.inv(frames)[map_]
    local = (back[:, :3, :3] @ points[numbers][object_][..., None])[..., 0] + back[:, :3, 3]
    local = local + rng.normal(0, sigma, local.shape)
    covariance = np.tile(SIGMA**2 * np.eye(3), (len(local), 1, 1))
    return points[numbers], frames, Measured(map_, object_, local, covariance)


def nearby(rng, frames):
    start = frames.copy()
    start[1:, :3, 3] += rng.normal(0, 0.1, (len(frames) - 1, 3))
    return start


def test_without_noise_frames_and_objects_are_exact():
    rng = np.random.default_rng(0)
    points, frames, measured = scene(rng, sigma=0.0)
    found = solve_frames(measured, nearby(rng, frames), len(points))
    np.testing.assert_allclose(found.site_T_map, frames, atol=1e-8)
    np.testing.assert_allclose(found.positions, points, atol=1e-8)


def test_the_covariances_are_those_of_repeated_measurements():
    rng, of_frames, of_objects = np.random.default_rng(1), [], []
    for _ in range(40):
        points, frames, measured = scene(rng)
        found = solve_frames(measured, nearby(rng, frames), len(points))
        # The frame of the result is that of the first map, whose errors are measurements as all others.
        off = found.positions - points
        of_objects += [e @ np.linalg.solve(c, e) for e, c in zip(off, found.covariance, strict=True)]
        turn = np.arctan2(found.site_T_map[:, 1, 0], found.site_T_map[:, 0, 0]) - np.arctan2(
            frames[:, 1, 0], frames[:, 0, 0]
        )
        moved = np.column_stack([(found.site_T_map - frames)[:, :3, 3], (turn + np.pi) % (2 * np.pi) - np.pi])
        of_frames += [e @ np.linalg.solve(c, e) for e, c in zip(moved[1:], found.frame_covariance[1:], strict=True)]
    assert 2.4 < np.mean(of_objects) < 3.6
    assert 3.2 < np.mean(of_frames) < 4.8


def test_an_object_that_one_map_has_elsewhere_moves_nothing():
    rng = np.random.default_rng(2)
    points, frames, measured = scene(rng)
    right = solve_frames(measured, nearby(rng, frames), len(points))
    one = np.flatnonzero(np.bincount(measured.object)[measured.object] >= 3)[-1]
    position = measured.position.copy()
    position[one] += [1.0, 0.0, 0.0]
    found = solve_frames(Measured(measured.map, measured.object, position, measured.covariance), frames, len(points))
    assert found.weight[one] < 0.05
    assert np.linalg.norm(found.positions - right.positions, axis=1).max() < SIGMA


def test_one_map_alone_stays_as_it_is():
    rng = np.random.default_rng(3)
    points, frames, measured = scene(rng, maps=1, count=9)
    found = solve_frames(measured, frames, len(points))
    np.testing.assert_allclose(found.positions, measured.position[np.argsort(measured.object)])
    np.testing.assert_allclose(found.covariance, np.tile(SIGMA**2 * np.eye(3), (len(points), 1, 1)))


def test_a_map_that_is_worse_than_it_says_counts_less():
    rng = np.random.default_rng(4)
    worse, even, factors = [], [], []
    for _ in range(20):
        points, frames, measured = scene(rng, maps=4, count=30)
        bad = measured.map == 2
        position = measured.position + bad[:, None] * rng.normal(0, 4 * SIGMA, measured.position.shape)
        found = solve_frames(Measured(measured.map, measured.object, position, measured.covariance), frames, len(points))
        factors.append(found.noise)
        known = measured.covariance * np.where(bad, 17.0, 1.0)[:, None, None]  # What would be right to claim.
        best = solve_frames(Measured(measured.map, measured.object, position, known), frames, len(points))
        worse += np.linalg.norm(found.positions - points, axis=1).tolist()
        even += np.linalg.norm(best.positions - points, axis=1).tolist()
    assert (np.mean(factors, axis=0)[2] > 3 * np.mean(factors, axis=0)[[0, 1, 3]]).all()
    assert np.mean(worse) < 1.15 * np.mean(even)
