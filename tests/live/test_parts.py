"""The small parts of a session, each against something that does the same for a whole log."""

from dataclasses import replace

import numpy as np
import pytest
from driving import feed
from hypothesis import given
from hypothesis import strategies as st
from quick import NOTHING_BESIDE

from objslam.association.observations import Observations
from objslam.association.refinement import information, normalised_residuals
from objslam.association.single_object_fit import fit_point
from objslam.config import Odometry, Settings, Triangulation, load_settings
from objslam.core.geometry import exp_se3, interpolate, inverse, lift_se2
from objslam.core.trajectory import Trajectory
from objslam.frontend.odometry_drift import gathered_drift
from objslam.live.mapper.course import Course
from objslam.live.mapper.keyframe_selection import KeyframeSelector
from objslam.live.mapper.pose_uncertainty import PoseUncertainty
from objslam.live.mapper.tables import GrowingTable, KeyframeTable, column
from objslam.live.mapper.trajectory_buffer import PathBuffer
from objslam.live.session.clock import Clock
from objslam.live.session.session import Session
from objslam.simulation import make_camera, preset, simulate
from objslam.simulation.scene import EXTENTS
from objslam.triangulation.triangulate import triangulate


def wiggle(count=400, rate=50.0):
    t = np.arange(count) / rate
    return 100 + t, lift_se2(np.stack([np.sin(0.3 * t) * 3, 0.4 * t, 0.8 * np.sin(0.5 * t)], axis=1))


@pytest.mark.parametrize("tilt", [0.0, 0.1])
def test_the_path_buffer_says_what_the_whole_path_says(tilt):
    stamps, poses = wiggle()
    poses = poses @ exp_se3(tilt * np.sin(stamps)[:, None] * np.array([1.0, 0.5, 0, 0, 0, 1.0]))
    asked = np.sort(np.concatenate([stamps[::7] + 0.007, stamps[::9]]))
    buffer, drift = PathBuffer(Odometry(), 100.0, 1.0), gathered_drift(Trajectory(stamps, poses), asked, Odometry())
    expected, _ = interpolate(stamps, poses, asked, 1.0)
    at = 0
    for stamp, pose in zip(stamps, poses, strict=True):
        buffer.append(stamp, pose)
        while at < len(asked) and asked[at] <= stamp:
            found = buffer.at(asked[at])
            np.testing.assert_allclose(found[0], expected[at], atol=1e-9)
            np.testing.assert_allclose(found[1], drift[at], atol=1e-12)
            at += 1
    assert at >= len(asked) - 1
    np.testing.assert_allclose(buffer.from_start(poses[9]), inverse(poses[0]) @ poses[9], atol=1e-12)


def test_the_path_buffer_forgets_and_knows_gaps():
    buffer = PathBuffer(Odometry(), 2.0, 1.0)
    for stamp in [*np.arange(0, 10, 0.1), 15.0]:
        buffer.append(float(stamp), np.eye(4))
        buffer.at(float(stamp))
    assert buffer.at(1.0) is None
    assert buffer.at(12.0) is None
    assert buffer.at(15.1) is None
    assert buffer.at(9.85).stretch == 0
    assert buffer.at(15.0).stretch == 1
    assert buffer.oldest > 5


def on_course(odometry, localization):
    """A course that heard poses at these stamps: the robot drives 1 m/s along x, its odometry began elsewhere."""
    course = Course(Settings())
    for stamp, by_odometry in sorted([*((s, True) for s in odometry), *((s, False) for s in localization)]):
        if by_odometry:
            course.add_odometry(stamp, lift_se2(np.array([3.0, stamp, np.pi / 2])), KeyframeTable())
        else:
            course.localization.append(stamp, lift_se2(np.array([stamp, 0.0, 0.0])))
    return course


def test_what_places_a_frame_is_decided_by_the_poses_alone():
    rate = np.arange(0, 10, 0.1).round(3).tolist()
    alone = on_course([], rate)
    assert alone.ready(9.9)
    assert not alone.ready(9.95)
    dead = on_course([0.0, 0.1], [])
    assert dead.ready(0.1)
    assert not dead.ready(0.15)
    for stamp in rate:
        dead.localization.append(stamp, np.eye(4))
        assert dead.ready(0.15) == (stamp > 1.2)  # poses.max_gap later, the odometry counts as silent
    ahead = on_course([], [*rate[:30], 500.0])
    for stamp in rate[:60]:
        ahead.add_odometry(stamp, np.eye(4), KeyframeTable())
    assert not ahead.ready(5.95)  # a localisation far ahead says nothing about the odometry
    assert ahead.ready(5.85)


def test_odometry_that_comes_back_waits_for_the_localisation_and_lies_as_it_says():
    course, keyframes = on_course(np.arange(0, 2, 0.1).tolist(), np.arange(0, 6, 0.1).tolist()), KeyframeTable()
    row = {"id": 0, "camera": 0, "frame": 0, "base_T_camera": np.eye(4), "mount": np.eye(4), "localized": True}

    def keep(stamp, placed):
        rows = {
            **row,
            "stamp": stamp,
            "sent": stamp,
            **vars(placed),
            "camera_T_start": np.eye(4),
            "map_T_base": lift_se2(np.array([stamp, 0.0, 0.0])),
        }
        keyframes.add(**{name: np.asarray(value)[None] for name, value in rows.items()})

    for number, stamp in enumerate((0.0, 1.0, 4.0)):
        assert course.ready(stamp)
        placed = course.place(stamp, keyframes, number - 1 if number else None)
        np.testing.assert_allclose(placed.start_T_base, lift_se2(np.array([stamp, 0.0, 0.0])), atol=1e-9)
        keep(stamp, placed)
    assert keyframes.by_odometry.tolist() == [True, True, False]
    assert keyframes.piece.tolist() == [0, 0, 1]
    for stamp in np.arange(6.0, 7.0, 0.1):
        course.add_odometry(float(stamp), lift_se2(np.array([-stamp, 7.0, np.pi])), keyframes)
    assert not course.ready(6.3)
    course.localization.append(6.0, lift_se2(np.array([6.0, 0.0, 0.0])))
    assert course.ready(6.3)  # the localisation has come to where the odometry begins, if not to the frame
    placed = course.place(6.3, keyframes, 2)
    assert (placed.by_odometry, placed.piece) == (True, 2)
    np.testing.assert_allclose(placed.start_T_base, lift_se2(np.array([6.3, 0.0, 0.0])), atol=1e-9)
    assert (np.linalg.eigvalsh(placed.drift - keyframes.drift[2]) > -1e-12).all()
    assert course.place(1.5, keyframes, 1).piece == 0  # late
    assert course.place(3.0, keyframes, 1) is None  # late, and on no piece near


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
    class Places(GrowingTable):
        number = column(np.int64)
        place = column(np.float64, 2)

    table = Places()
    for i in range(300):
        table.add(number=[i], place=[[i, -i]])
    table.place[7] = 5.0
    other = table.copy()
    table.keep(table.number % 3 == 1)
    np.testing.assert_array_equal(table.number[:3], [1, 4, 7])
    np.testing.assert_array_equal(table.place[2], [5.0, 5.0])
    assert (len(table), len(other)) == (100, 300)


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
        s = Observations.of_lines(origin, direction, np.full(20, 0.004), nothing, nothing)
        met = fit_point(s, rng)
        batch = triangulate(origin, direction, np.zeros(20, dtype=int), 1, 0.004, Triangulation())
        assert np.linalg.norm(met.position - batch.positions[0]) < 0.03
        assert met.inlier[outliers:].mean() > 0.9
        assert met.parallax == pytest.approx(batch.parallax[0], rel=0.05)
        off = met.position - [0.3, 3.0, 0.5]
        assert off @ np.linalg.solve(met.covariance, off) < 25


def test_rays_that_do_not_meet():
    origin, nothing = np.zeros((3, 3)), np.full(3, np.nan)
    s = Observations.of_lines(origin, np.tile([0.0, 1.0, 0.0], (3, 1)), np.full(3, 0.004), nothing, nothing)
    assert fit_point(s, np.random.default_rng(0)) is None


def test_misses_and_information_in_closed_form():
    s = Observations.of_lines(np.zeros((1, 3)), np.array([[1.0, 0, 0]]), np.array([0.01]), np.array([2.0]), np.array([0.1]))
    assert normalised_residuals(s, np.array([2.0, 0.04, 0.0]))[0] == pytest.approx(2.0, rel=1e-3)
    assert normalised_residuals(s, np.array([-2.0, 0.0, 0.0]))[0] == np.inf
    np.testing.assert_allclose(information(s, np.array([2.0, 0, 0]))[0], np.diag([100.0, 2500.0, 2500.0]))


def test_what_the_cameras_uncertainty_makes_of_a_landmark_by_sampling():
    rng = np.random.default_rng(0)
    from objslam.core.geometry import exp_se3

    pose, to = lift_se2(np.array([1.0, 2.0, 0.6])), np.array([[2.0, 1.0, 0.3]])
    covariance = np.diag([0.01, 0.02, 0.03, 0.05, 0.04, 0.02]) ** 2
    point = pose[:3, 3] + to[0]
    local = pose[:3, :3].T @ to[0]
    moved = pose @ exp_se3(rng.multivariate_normal(np.zeros(6), covariance, 40_000))
    seen = moved[:, :3, :3] @ local + moved[:, :3, 3] - point
    drift = np.eye(6)  # so large that the covariance of the pose counts
    found = PoseUncertainty(drift, np.eye(6), covariance).of_landmarks(to, np.zeros((1, 6, 6)), pose)
    np.testing.assert_allclose(found[0], np.cov(seen.T), atol=3e-4)


def test_asking_whether_a_frame_is_redundant_changes_nothing():
    selector = KeyframeSelector(load_settings(None, ()).live)
    here, there = np.eye(4), lift_se2(np.array([5.0, 0.0, 0.0]))
    for _ in range(20):
        selector.accept(0, here, {1})
    assert selector.is_redundant(0, here, {1})
    assert not selector.is_redundant(0, here, {1, 2})
    assert not selector.is_redundant(0, there, {1})
    assert selector.is_redundant(0, here, {1})  # it was only asked about a frame from elsewhere
    selector.pass_over(0, there)
    assert not selector.is_redundant(0, here, {1})  # now it has been elsewhere


@pytest.mark.parametrize("sees_size", [True, False])
def test_the_sizes_of_landmarks_are_those_of_their_things(sees_size):
    """The boxes of far and near things, from odometry that drifts: a session measures what the simulation drew."""
    camera = replace(make_camera(), sees_size=sees_size)
    drive = preset("demo", cameras=(camera,), frames=200, localization=None, laps=1.0)
    settings = load_settings(None, ("association.method=global", *NOTHING_BESIDE))
    session = feed(Session(settings, patient=True).start(), simulate(drive, 0))
    m = session._mapper.state
    assert len(m.landmarks) >= 10
    known = m.landmarks.sized >= 5
    assert known.all() if sees_size else not known.any()
    true = np.log([EXTENTS[m.labels[label]] for label in m.landmarks.label[known].tolist()])
    assert (np.abs(m.landmarks.ln_size[known] - true.reshape(-1, 2)) < 0.1).all()
    session.abort()
