"""The small parts of a session, each against something that does the same for a whole log."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from objslam.config import Odometry, Triangulation
from objslam.geometry import exp_se3, interpolate, inverse, lift_se2
from objslam.keyframes import gathered_drift
from objslam.live.clock import Clock
from objslam.live.known import carried
from objslam.live.meeting import information, meet, misses, sightings
from objslam.live.path import PathBuffer
from objslam.live.table import Table
from objslam.triangulation import triangulate
from objslam.types import Trajectory


def wiggle(count=400, rate=50.0):
    t = np.arange(count) / rate
    return 100 + t, lift_se2(np.stack([np.sin(0.3 * t) * 3, 0.4 * t, 0.8 * np.sin(0.5 * t)], axis=1))


@pytest.mark.parametrize("tilt", [0.0, 0.1])
def test_the_path_buffer_says_what_the_whole_path_says(tilt):
    stamps, poses = wiggle()
    poses = poses @ exp_se3(tilt * np.sin(stamps)[:, None] * np.array([1.0, 0.5, 0, 0, 0, 1.0]))
    asked = np.sort(np.concatenate([stamps[::7] + 0.007, stamps[::9]]))
    buffer, drift = PathBuffer(Odometry(), 100.0), gathered_drift(Trajectory(stamps, poses), asked, Odometry())
    expected, _ = interpolate(stamps, poses, asked, 1.0)
    at = 0
    for stamp, pose in zip(stamps, poses, strict=True):
        buffer.append(stamp, pose)
        while at < len(asked) and asked[at] <= stamp:
            found = buffer.at(asked[at], 1.0)
            np.testing.assert_allclose(found[0], expected[at], atol=1e-9)
            np.testing.assert_allclose(found[1], drift[at], atol=1e-12)
            at += 1
    assert at >= len(asked) - 1
    np.testing.assert_allclose(buffer.from_start(poses[9]), inverse(poses[0]) @ poses[9], atol=1e-12)


def test_the_path_buffer_forgets_and_knows_gaps():
    buffer = PathBuffer(Odometry(), 2.0)
    for stamp in [*np.arange(0, 10, 0.1), 15.0]:
        buffer.append(float(stamp), np.eye(4))
        buffer.at(float(stamp), 1.0)
    assert buffer.at(1.0, 1.0) is None
    assert buffer.at(12.0, 1.0) is None
    assert buffer.at(15.0, 1.0) is not None
    assert buffer.at(15.1, 1.0) is None
    assert buffer.oldest > 5


@given(st.lists(st.floats(-100, 100), min_size=1, max_size=200))
def test_session_time_never_goes_back(stamps):
    clock, times = Clock(), []
    for stamp in stamps:
        at, _ = clock.step(stamp)
        if at is not None:
            times.append(at)
    assert (np.diff(times) > 0).all()


def test_a_clock_set_back_is_followed_and_late_stamps_are_not():
    clock = Clock()
    for stamp in np.arange(0, 10, 0.01):
        clock.step(float(stamp))
    assert clock.step(9.8) == (None, False)
    assert clock.step(1.0) == (None, False)  # one alone is late
    assert clock.step(10.0)[0] == 10.0
    backs = [clock.step(3.0 + 0.01 * i) for i in range(8)]
    assert [back for _, back in backs].count(True) == 1
    assert clock.place(3.05, clock.newest - 1, clock.newest + 1) == pytest.approx(3.05 + clock.shift)
    assert clock.place(9.9, clock.newest - 1, clock.newest + 1) == 9.9  # from before it was set back


def test_columns_grow_and_shrink():
    table = Table(number=(np.int64, ()), place=(np.float64, (2,)))
    for i in range(300):
        table.add(number=[i], place=[[i, -i]])
    table.place[7] = 5.0
    other = table.copy()
    table.keep(table.number % 3 == 1)
    np.testing.assert_array_equal(table.number[:3], [1, 4, 7])
    np.testing.assert_array_equal(table.place[2], [5.0, 5.0])
    assert (len(table), len(other)) == (100, 300)
    with pytest.raises(AttributeError):
        table.nothing  # noqa: B018


def scene(outliers, rng):
    origin = np.column_stack([np.linspace(-1, 1, 20), rng.normal(0, 0.1, 20), np.zeros(20)])
    to = np.array([0.3, 3.0, 0.5]) - origin
    direction = to / np.linalg.norm(to, axis=1, keepdims=True) + rng.normal(0, 0.004, (20, 3))
    direction[:outliers] = rng.normal([0.0, 2.0, 0.0], 1.0, (outliers, 3))
    return origin, direction / np.linalg.norm(direction, axis=1, keepdims=True)


@pytest.mark.parametrize("outliers", [0, 7])
def test_rays_meet_where_the_triangulation_says(outliers):
    for seed in range(10):
        rng = np.random.default_rng(seed)
        origin, direction = scene(outliers, rng)
        nothing = np.full(20, np.nan)
        s = sightings(origin, direction, np.full(20, 0.004), nothing, nothing)
        met = meet(s, rng)
        batch = triangulate(origin, direction, np.zeros(20, dtype=int), 1, 0.004, Triangulation())
        assert np.linalg.norm(met.position - batch.positions[0]) < 0.03
        assert met.agree[outliers:].mean() > 0.9
        assert met.parallax == pytest.approx(batch.parallax[0], rel=0.05)
        off = met.position - [0.3, 3.0, 0.5]
        assert off @ np.linalg.solve(met.covariance, off) < 25


def test_rays_that_do_not_meet():
    origin, nothing = np.zeros((3, 3)), np.full(3, np.nan)
    s = sightings(origin, np.tile([0.0, 1.0, 0.0], (3, 1)), np.full(3, 0.004), nothing, nothing)
    assert meet(s, np.random.default_rng(0)) is None


def test_misses_and_information_in_closed_form():
    s = sightings(np.zeros((1, 3)), np.array([[1.0, 0, 0]]), np.array([0.01]), np.array([2.0]), np.array([0.1]))
    assert misses(s, np.array([2.0, 0.04, 0.0]))[0] == pytest.approx(2.0, rel=1e-3)
    assert misses(s, np.array([-2.0, 0.0, 0.0]))[0] == np.inf
    np.testing.assert_allclose(information(s, np.array([2.0, 0, 0]))[0], np.diag([100.0, 2500.0, 2500.0]))


def test_what_the_cameras_doubt_makes_of_a_landmark_by_sampling():
    rng = np.random.default_rng(0)
    from objslam.geometry import exp_se3

    pose, to = lift_se2(np.array([1.0, 2.0, 0.6])), np.array([[2.0, 1.0, 0.3]])
    covariance = np.diag([0.01, 0.02, 0.03, 0.05, 0.04, 0.02]) ** 2
    point = pose[:3, 3] + to[0]
    local = pose[:3, :3].T @ to[0]
    moved = pose @ exp_se3(rng.multivariate_normal(np.zeros(6), covariance, 40_000))
    seen = moved[:, :3, :3] @ local + moved[:, :3, 3] - point
    np.testing.assert_allclose(carried(to, covariance, pose)[0], np.cov(seen.T), atol=3e-4)
