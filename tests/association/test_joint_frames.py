"""Frames of many maps: exact without noise, as repeated measurements say with it, and steady against a moved object."""

from dataclasses import replace

import numpy as np
from association.registration_scenes import SIGMA

from objslam.association.registration.joint_frames import Measured, solve_frames
from objslam.core.geometry import align, lift_se2
from objslam.core.maps.shared_covariance import jacobian


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


SHARED = np.diag([0.2, 0.2, 0.05, 0.01, 0.01, 0.03, 0.02]) ** 2


def grown(measured, maps, sizes, rng=None):
    """The measurements of maps with shared errors: of these sizes, or also shifted and turned if there is an rng."""
    roots = np.tile(np.linalg.cholesky(SHARED), (maps, 1, 1))
    errors = np.zeros((maps, 7))
    if rng is not None:
        errors = (roots @ rng.normal(size=(maps, 7, 1)))[..., 0]
    errors[:, 6] += sizes
    off = (jacobian(measured.position) @ errors[measured.map][..., None])[..., 0]
    return replace(measured, position=measured.position + off, roots=roots)


def test_a_map_of_uncertain_size_takes_the_size_of_a_map_that_knows_it():
    """The second of two maps has its own size exactly, and the first is 4 % too large, as it says it may be."""
    rng = np.random.default_rng(5)
    for _ in range(5):
        points, frames, measured = scene(rng, maps=2, count=30, sigma=0.01)
        measured = replace(measured, covariance=1e-4 * np.tile(np.eye(3), (len(measured.map), 1, 1)))
        given = grown(measured, 2, np.array([0.04, 0.0]))
        given.roots[1] = 0.0
        found = solve_frames(given, nearby(rng, frames), len(points))
        blind = solve_frames(replace(given, roots=None), nearby(rng, frames), len(points))
        assert abs(align(found.positions, points, "sim2")[1] - 1) < 0.006
        assert abs(align(blind.positions, points, "sim2")[1] - 1) > 0.012


def test_the_covariances_hold_the_truth_where_maps_share_errors():
    """All seven shared errors of each map are drawn from their covariance. The frame of the result is the first map's."""
    rng, squared, own, sizes = np.random.default_rng(6), [], [], []
    for _ in range(60):
        points, frames, measured = scene(rng, maps=3, count=20)
        found = solve_frames(grown(measured, 3, np.zeros(3), rng), nearby(rng, frames), len(points))
        off = found.positions - points
        squared += [e @ np.linalg.solve(c, e) for e, c in zip(off, found.covariance, strict=True)]
        own.append(np.trace(found.own, axis1=1, axis2=2).mean() / np.trace(found.covariance, axis1=1, axis2=2).mean())
        sizes.append(1 / align(found.positions, points, "sim2")[1] - 1)
        factor = found.correlated
        np.testing.assert_allclose(found.own + factor @ np.swapaxes(factor, 1, 2), found.covariance, atol=1e-12)
    assert 2.3 < np.mean(squared) < 3.6
    assert np.mean(np.array(squared) < 7.815) > 0.93
    assert np.mean(own) < 0.2  # Most of an object's error is shared, so it is no small thing that the rest is told apart.
    assert abs(np.mean(sizes)) < 3 * np.std(sizes) / np.sqrt(len(sizes))


def test_noise_makes_no_map_smaller():
    """Two maps of one size, with noise of a tenth of their extent. Only their sizes are uncertain."""
    rng, sizes = np.random.default_rng(7), []
    for _ in range(60):
        points, frames, measured = scene(rng, maps=2, count=20, sigma=0.3)
        roots = np.zeros((2, 7, 7))
        roots[:, 6, 6] = 0.2
        given = replace(measured, covariance=0.09 * np.tile(np.eye(3), (len(measured.map), 1, 1)), roots=roots)
        found = solve_frames(given, nearby(rng, frames), len(points))
        sizes.append(np.log(align(points, found.positions, "sim2")[1]))
    assert abs(np.mean(sizes)) < 3 * np.std(sizes) / np.sqrt(len(sizes))
