from itertools import combinations, pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.linalg import expm, logm
from scipy.optimize import minimize
from scipy.spatial.transform import Rotation

from objslam.core.geometry import (
    adjoint,
    align,
    exp_se3,
    interpolate,
    interpolate_pair,
    inverse,
    is_planar,
    lift_se2,
    log_se3,
    make_pose,
    motion_between,
    nearest_points,
    pose_from_quaternion,
    quaternion,
    skew,
    split_se2,
    twist_lengths,
    widest_angle,
)

numbers = st.floats(-5, 5, allow_nan=False)
angles = st.floats(-3.1, 3.1)
seeds = st.integers(0, 2**32 - 1)


def vectors(size, elements=numbers):
    return st.lists(elements, min_size=size, max_size=size).map(np.array)


@st.composite
def twists(draw):
    """Twists with a rotation of any angle up to just short of half a turn, tiny ones among them."""
    axis = draw(vectors(3).filter(lambda v: np.linalg.norm(v) > 0.1))
    angle = draw(st.one_of(st.floats(0, 3.13), st.floats(-9, 0).map(lambda e: 10**e), st.just(0.0)))
    return np.concatenate([axis / np.linalg.norm(axis) * angle, draw(vectors(3))])


def hat(twist):
    """The (4, 4) matrix of a twist in the Lie algebra, written out."""
    (a, b, c), (x, y, z) = twist[:3], twist[3:]
    return np.array([[0, -c, b, x], [c, 0, -a, y], [-b, a, 0, z], [0, 0, 0, 0]])


def some_poses(seed, count, angle=3.0, reach=5.0):
    rng = np.random.default_rng(seed)
    axis = rng.standard_normal((count, 3))
    axis *= (rng.uniform(-angle, angle, count) / np.linalg.norm(axis, axis=1))[:, None]
    return make_pose(Rotation.from_rotvec(axis).as_matrix(), rng.uniform(-reach, reach, (count, 3)))


def some_lines(seed, count):
    v = np.random.default_rng(seed).standard_normal((count, 3))
    return v / np.linalg.norm(v, axis=1, keepdims=True)


@given(twists())
def test_exponential_is_the_matrix_exponential(twist):
    np.testing.assert_allclose(exp_se3(twist[None])[0], expm(hat(twist)), atol=1e-10)


@given(twists())
def test_logarithm_is_the_matrix_logarithm(twist):
    pose = expm(hat(twist))
    back = log_se3(pose[None])[0]
    np.testing.assert_allclose(hat(back), np.real(logm(pose)), atol=1e-6)  # logm itself is no better near half a turn
    np.testing.assert_allclose(back, twist, atol=1e-8)


@given(st.lists(twists(), min_size=1, max_size=5).map(np.array))
def test_logarithm_undoes_the_exponential_in_a_batch(batch):
    np.testing.assert_allclose(log_se3(exp_se3(batch)), batch, atol=1e-9)


@pytest.mark.parametrize("angle", [0.0, 1e-12, 1e-6, 0.99e-4, 1.01e-4, 1e-3, 1.0, np.pi - 1e-6])
def test_exponential_and_logarithm_hold_where_their_series_take_over(angle):
    twist = np.array([[0.6 * angle, 0.0, 0.8 * angle, 1.0, -2.0, 3.0]])
    np.testing.assert_allclose(exp_se3(twist)[0], expm(hat(twist[0])), atol=1e-11)
    np.testing.assert_allclose(log_se3(exp_se3(twist)), twist, atol=1e-8)


@given(seeds, st.sampled_from([0.0, 1e-9, 1e-4, 0.1, 1.8]))
def test_lengths_of_a_twist_are_those_of_the_logarithm(seed, size):
    twist = size * np.random.default_rng(seed).uniform(-1, 1, (20, 6))
    turn, way = twist_lengths(exp_se3(twist))
    np.testing.assert_allclose(turn, np.linalg.norm(twist[:, :3], axis=1), rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(way, np.linalg.norm(twist[:, 3:], axis=1), rtol=1e-9, atol=1e-12)


@given(seeds)
def test_inverse_undoes_the_pose_in_any_shape(seed):
    poses = some_poses(seed, 6).reshape(2, 3, 4, 4)
    np.testing.assert_allclose(poses @ inverse(poses), np.broadcast_to(np.eye(4), poses.shape), atol=1e-12)
    np.testing.assert_allclose(inverse(poses[0, 0]), np.linalg.inv(poses[0, 0]), atol=1e-12)


@given(twists(), twists())
def test_adjoint_moves_a_twist_through_a_pose(frame, twist):
    pose = expm(hat(frame))
    moved = adjoint(pose) @ twist
    np.testing.assert_allclose(hat(moved), pose @ hat(twist) @ np.linalg.inv(pose), atol=1e-9)


def test_adjoint_of_a_product_is_the_product_of_adjoints():
    a, b = some_poses(0, 4), some_poses(1, 4)
    np.testing.assert_allclose(adjoint(a @ b), adjoint(a) @ adjoint(b), atol=1e-10)


@given(vectors(3), vectors(3))
def test_skew_is_the_cross_product(a, b):
    np.testing.assert_allclose(skew(a) @ b, np.cross(a, b), atol=1e-12)


@given(seeds)
def test_quaternions_go_both_ways_whatever_their_length(seed):
    poses = some_poses(seed, 5)
    xyzw = quaternion(poses)
    np.testing.assert_allclose(np.linalg.norm(xyzw, axis=1), 1.0)
    assert (xyzw[:, 3] >= 0).all()
    np.testing.assert_allclose(pose_from_quaternion(poses[:, :3, 3], -2.5 * xyzw), poses, atol=1e-12)
    x, y, z, w = xyzw[0]  # the rotation of the first, written out
    first = np.array([1 - 2 * (y * y + z * z), 2 * (x * y + z * w), 2 * (x * z - y * w)])
    np.testing.assert_allclose(poses[0, :3, 0], first, atol=1e-12)


@given(vectors(2), angles, vectors(2))
def test_a_lifted_pose_is_a_turn_and_a_shift_on_the_floor(xy, yaw, point):
    pose = lift_se2(np.array([*xy, yaw]))
    turned = complex(*point) * np.exp(1j * yaw) + complex(*xy)
    np.testing.assert_allclose(pose @ [*point, 0.7, 1], [turned.real, turned.imag, 0.7, 1], atol=1e-12)


@given(seeds)
def test_split_and_lift_make_the_pose_again(seed):
    poses = some_poses(seed, 6).reshape(3, 2, 4, 4)
    part, rest = split_se2(poses)
    np.testing.assert_allclose(lift_se2(part) @ rest, poses, atol=1e-12)
    np.testing.assert_allclose(rest[..., :2, 3], 0.0, atol=1e-12)  # the remainder neither shifts on the floor
    np.testing.assert_allclose(rest[..., 1, 0], 0.0, atol=1e-12)  # nor turns the heading
    assert (rest[..., 0, 0] >= 0).all()


@given(vectors(2), angles)
def test_split_gives_back_what_was_lifted(xy, yaw):
    part, rest = split_se2(lift_se2(np.array([*xy, yaw])))
    np.testing.assert_allclose(part, [*xy, yaw], atol=1e-12)
    np.testing.assert_allclose(rest, np.eye(4), atol=1e-12)


def test_split_of_a_pose_that_looks_straight_up_is_whole():
    up = make_pose(Rotation.from_euler("y", -90, degrees=True).as_matrix().round(15), np.array([1.0, 2.0, 3.0]))
    part, rest = split_se2(up)
    np.testing.assert_allclose(part, [1, 2, 0], atol=1e-12)
    np.testing.assert_allclose(lift_se2(part) @ rest, up, atol=1e-12)


@given(seeds)
def test_planar_paths_keep_height_and_tilt(seed):
    rng = np.random.default_rng(seed)
    path = lift_se2(rng.uniform(-3, 3, (8, 3)))
    tilted = path @ some_poses(seed, 1, angle=0.4)  # a sensor fixed to the robot, and its tilt
    assert is_planar(path)
    assert is_planar(path @ make_pose(np.eye(3), np.array([0.0, 0.0, 0.4])))
    assert is_planar(path[:0])
    assert not is_planar(path + 1e-4 * np.arange(8)[:, None, None] * (np.arange(16).reshape(4, 4) == 11))
    rolling = Rotation.from_rotvec(np.linspace(0, 0.01, 8)[:, None] * [1.0, 0.0, 0.0]).as_matrix()
    assert is_planar(tilted)
    assert not is_planar(path @ make_pose(rolling, np.zeros(3)))


@given(seeds, st.floats(0.01, 0.99))
def test_between_two_poses_the_path_is_the_matrix_power(seed, fraction):
    a, b = some_poses(seed, 2, angle=1.4)
    query = np.array([10.0 + 2 * fraction])
    got, valid = interpolate(np.array([10.0, 12.0]), np.stack([a, b]), query, max_gap=2.0)
    assert valid.all()
    np.testing.assert_allclose(got[0], a @ np.real(expm(fraction * logm(np.linalg.inv(a) @ b))), atol=1e-7)


@given(seeds, twists(), st.floats(0, 1))
def test_a_pair_is_interpolated_as_a_path_is(seed, twist, share):
    first = some_poses(seed, 1)[0]
    second = first @ exp_se3(twist)
    expected, _ = interpolate(np.array([0.0, 1.0]), np.stack([first, second]), np.array([share]), max_gap=1.0)
    np.testing.assert_allclose(interpolate_pair(first, second, share), expected[0], atol=1e-11)


@given(seeds, twists())
def test_the_motion_between_two_poses_is_a_turn_and_a_way_in_the_map(seed, twist):
    first = some_poses(seed, 1)[0]
    second = first @ exp_se3(twist)
    axis, angle, way = motion_between(first, second)
    turn = Rotation.from_matrix(second[:3, :3] @ first[:3, :3].T).as_rotvec()
    np.testing.assert_allclose(angle, np.linalg.norm(turn), atol=1e-7)
    np.testing.assert_allclose(axis, np.sinc(angle / np.pi) * turn, atol=1e-7)
    np.testing.assert_allclose(way, second[:3, 3] - first[:3, 3], atol=1e-12)


def test_between_two_planar_poses_the_path_is_an_arc():
    radius, turn = 2.0, 1.2  # left around (0, 2), from the origin
    ends = lift_se2(np.array([[0.0, 0.0, 0.0], [radius * np.sin(turn), radius * (1 - np.cos(turn)), turn]]))
    query = np.linspace(0, 1, 7)
    expected = np.column_stack([radius * np.sin(turn * query), radius * (1 - np.cos(turn * query)), turn * query])
    got, valid = interpolate(np.array([0.0, 1.0]), ends, query, max_gap=1.0)
    assert valid.all()
    np.testing.assert_allclose(got, lift_se2(expected), atol=1e-12)


@given(seeds, st.integers(1, 12))
def test_exact_stamps_give_the_poses_themselves_even_at_a_gap(seed, count):
    stamps = np.cumsum(np.random.default_rng(seed).uniform(0.1, 3.0, count)) + 1.7e9
    poses = some_poses(seed, count)
    got, valid = interpolate(stamps, poses, stamps, max_gap=0.05)
    assert valid.all()
    np.testing.assert_allclose(got, poses, atol=1e-9)


@given(seeds, st.integers(1, 12), st.floats(0.2, 2.0))
def test_valid_is_inside_and_not_in_a_gap(seed, count, max_gap):
    rng = np.random.default_rng(seed)
    stamps = np.cumsum(rng.uniform(0.1, 3.0, count))
    query = rng.uniform(stamps[0] - 1, stamps[-1] + 1, 40)
    got, valid = interpolate(stamps, some_poses(seed, count), query, max_gap)
    for at, good, pose in zip(query, valid, got, strict=True):
        around = [b - a for a, b in pairwise(stamps) if a <= at <= b]
        assert good == any(gap <= max_gap for gap in around)
        if not good:
            np.testing.assert_array_equal(pose, np.eye(4))


def test_no_path_and_no_query_give_nothing():
    got, valid = interpolate(np.zeros(0), np.zeros((0, 4, 4)), np.array([1.0]), 0.5)
    assert not valid.any()
    assert got.shape == (1, 4, 4)
    got, valid = interpolate(np.array([0.0, 1.0]), some_poses(0, 2), np.zeros(0), 5.0)
    assert got.shape == (0, 4, 4)
    assert len(valid) == 0


@given(seeds, st.sampled_from(["se2", "sim2", "se3", "sim3"]), st.floats(0.2, 5.0))
def test_alignment_finds_the_transform_that_was_applied(seed, kind, factor):
    source = np.random.default_rng(seed).uniform(-4, 4, (10, 3))
    moved = some_poses(seed, 1)[0] if kind in ("se3", "sim3") else lift_se2(np.random.default_rng(seed).uniform(-3, 3, 3))
    moved[2, 3] = 0.7
    scale = factor if kind in ("sim2", "sim3") else 1.0
    target = scale * source @ moved[:3, :3].T + moved[:3, 3]
    pose, got = align(source, target, kind)
    np.testing.assert_allclose(pose, moved, atol=1e-9)
    assert got == pytest.approx(scale)


@pytest.mark.parametrize("kind", ["se2", "sim2", "se3", "sim3"])
@pytest.mark.parametrize("seed", [0, 1, 2])
def test_alignment_of_noisy_points_is_a_least_squares_optimum(kind, seed):
    rng = np.random.default_rng(seed)
    source = rng.uniform(-4, 4, (8, 3))
    target = source @ some_poses(seed, 1, angle=1.0)[0][:3, :3].T + rng.standard_normal((8, 3))

    def cost(x):
        rotation = Rotation.from_rotvec(x[:3] if kind in ("se3", "sim3") else [0, 0, x[2]]).as_matrix()
        residual = (x[6] if kind in ("sim2", "sim3") else 1.0) * source @ rotation.T + x[3:6] - target
        return (residual[:, :2] ** 2).sum() if kind == "sim2" else (residual**2).sum()

    pose, scale = align(source, target, kind)
    mine = np.concatenate([Rotation.from_matrix(pose[:3, :3]).as_rotvec(), pose[:3, 3], [scale]])
    best = min(minimize(cost, np.array([0, 0, yaw, 0, 0, 0, 1.0])).fun for yaw in (-2, 0, 2))
    assert cost(mine) == pytest.approx(best, rel=1e-6)


def test_alignment_of_too_few_points_shifts_only():
    source, target = np.array([[1.0, 2.0, 3.0]]), np.array([[4.0, 4.0, 4.0]])
    for kind in ("se2", "sim2", "se3", "sim3"):
        pose, scale = align(source, target, kind)
        np.testing.assert_allclose(pose, make_pose(np.eye(3), np.array([3.0, 2.0, 1.0])))
        assert scale == 1.0
    two = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]])
    np.testing.assert_allclose(align(two, two[:, [1, 0, 2]], "se3")[0][:3, :3], np.eye(3))
    np.testing.assert_allclose(align(two, two[:, [1, 0, 2]], "se2")[0] @ [1, 0, 0, 1], [0, 1, 0, 1], atol=1e-12)
    for points in (two, two[:0]):
        pose, scale = align(points, points + 1, "none")
        np.testing.assert_array_equal(pose, np.eye(4))
        assert scale == 1.0


@given(seeds, st.sampled_from(["se3", "sim3"]), st.integers(0, 2), st.floats(0.2, 5.0))
def test_alignment_never_mirrors(seed, kind, axis, factor):
    source = np.random.default_rng(seed).uniform(-1, 1, (10, 3))
    mirrored = source * np.where(np.arange(3) == axis, -factor, factor)
    pose, scale = align(source, mirrored @ some_poses(seed, 1)[0][:3, :3].T, kind)
    assert np.linalg.det(pose[:3, :3]) == pytest.approx(1.0)
    assert scale > 0


@given(seeds, st.sampled_from(["se3", "sim3"]), st.integers(3, 6))
def test_alignment_of_points_on_a_line_turns_no_further_than_the_line(seed, kind, count):
    rng = np.random.default_rng(seed)
    along, toward = (v / np.linalg.norm(v) for v in rng.standard_normal((2, 3)))
    at = rng.uniform(-3, 3, (count, 1)) + np.arange(count)[:, None]
    scale = 2.0 if kind == "sim3" else 1.0
    pose, got = align(at * along, scale * at * toward + [1.0, 2.0, 3.0], kind)
    turned = Rotation.from_matrix(pose[:3, :3])
    np.testing.assert_allclose(turned.apply(along), toward, atol=1e-7)
    assert turned.magnitude() == pytest.approx(np.arccos(np.clip(along @ toward, -1, 1)), abs=1e-6)
    assert got == pytest.approx(scale)


@given(seeds, st.integers(2, 25))
def test_widest_angle_of_a_few_lines_is_that_of_the_widest_pair(seed, count):
    lines = some_lines(seed, count)
    widest = max(np.arctan2(np.linalg.norm(np.cross(a, b)), abs(a @ b)) for a, b in combinations(lines, 2))
    assert widest_angle(lines) == pytest.approx(widest, abs=1e-7)


@settings(max_examples=30)
@given(seeds, st.floats(0.001, 1.5), st.integers(401, 900))
def test_widest_angle_of_many_lines_is_all_but_exact(seed, spread, count):
    rng = np.random.default_rng(seed)
    lines = np.array([1.0, 0.0, 0.0]) + rng.uniform(-spread, spread, (count, 3))
    lines /= np.linalg.norm(lines, axis=1, keepdims=True)
    exact = np.arccos(np.clip(np.abs(lines @ lines.T), 0, 1).min())
    assert 0.95 * exact <= widest_angle(lines) <= exact + 1e-12


def test_widest_angle_of_opposite_or_single_lines_is_none():
    assert widest_angle(np.zeros((0, 3))) == 0.0
    assert widest_angle(np.array([[1.0, 0.0, 0.0]])) == 0.0
    assert widest_angle(np.array([[1.0, 0.0, 0.0], [-1.0, 0.0, 0.0]])) == 0.0


@pytest.mark.parametrize("number", [1, 2, 9, 100, 400])
def test_nearest_points_are_those_of_all_distances(number):
    """Few points, and many for which a search tree is faster."""
    position = np.random.default_rng(0).normal(size=(number, 3))
    count = min(9, number)
    found = np.sort(nearest_points(position, count), axis=1)
    expected = np.argsort(np.linalg.norm(position[:, None] - position, axis=2), axis=1)[:, :count]
    np.testing.assert_array_equal(found, np.sort(expected, axis=1))
