"""A session estimates the errors that all measurements share while it runs, and goes on without them."""

from dataclasses import replace

import numpy as np
import pytest
from added_errors import add_shared_errors
from driving import feed
from test_mixed_paths import ORDERS, heard
from test_mixed_paths import drive as hear
from test_session import make_log

from objslam.config import Odometry, load_settings
from objslam.core.calibration import Calibration
from objslam.core.geometry import lift_se2, make_pose
from objslam.core.noise import NOMINAL
from objslam.core.rotation import rotation_from_vector, rotation_vector
from objslam.core.trajectory import Trajectory
from objslam.core.types import Log
from objslam.frontend.corrected_odometry import OdometryCorrection
from objslam.frontend.shared_errors import SharedErrors
from objslam.io.calibration_yaml import dump_calibration
from objslam.live.adapters.replay import events
from objslam.live.calibration.calibrator import Calibrator, observed
from objslam.live.calibration.recalibration import recalibrate
from objslam.live.session.session import Session
from objslam.simulation import PoseNoise, preset, simulate
from objslam.simulation.settings import DepthNoise

ERRORS = {"odometry.scale": 0.05, "odometry.turn_scale": -0.06, "front.clock": 0.12, "front.yaw": 0.03}
QUIET = Odometry(x_per_m=0.005, yaw_per_m=0.005, yaw_per_rad=0.01)
ALONE = ("output.recording=false", "checks.use=false", "bodies.use=false")
"""Shared errors are found without bodies and without checks of the input."""


def settings_of(*more):
    noise = ("odometry.x_per_m=0.005", "odometry.yaw_per_m=0.005", "odometry.yaw_per_rad=0.01")
    return load_settings(None, ("mode=joint", "rays.pixel_sigma=2", *ALONE, *noise, *more))


@pytest.fixture(scope="module")
def log():
    """A drive of a robot with shared errors. Its truth is that of the room."""
    changes = {"frames": 200, "classes": 12, "false": 0.0, "localization": None, "odometry": QUIET, "depth": DepthNoise()}
    return add_shared_errors(simulate(preset("demo", **changes), 3), ERRORS)


@pytest.fixture(scope="module")
def file(tmp_path_factory):
    """What `objslam calibrate` would have found: the truth, known well."""
    names, values = tuple(ERRORS), np.array(list(ERRORS.values()))
    path = tmp_path_factory.mktemp("robot") / "calibration.yaml"
    path.write_text(dump_calibration(Calibration(names, values, np.diag([1e-6] * 4), np.full(4, 0.05))))
    return path


def drive(log, settings, **more):
    return feed(Session(settings, patient=True, **more).start(), log)


def rmse(found, log):
    true = {o.label: o.position for o in log.truth.objects}
    off = [o.position - true[o.label] for o in found.resolved()]
    assert len(off) >= 10
    return float(np.sqrt(np.mean(np.sum(np.square(off), axis=1))))


@pytest.mark.parametrize("turn", [0.05, 2.0])  # rad. The second also makes steps of more than a quarter turn.
@pytest.mark.parametrize("tilt", [0.0, 0.3])
def test_odometry_is_corrected_pose_by_pose_as_a_whole(turn, tilt):
    rng = np.random.default_rng(2)
    steps = np.cumsum(rng.normal([0.05, 0.0, 0.02], [0.02, 0.02, turn], (400, 3)), axis=0)
    tilts = make_pose(rotation_from_vector(rng.normal(0, tilt, (400, 3))), np.zeros((400, 3)))
    said = Trajectory(np.cumsum(rng.uniform(0.02, 0.08, 400)), lift_se2(steps) @ tilts)
    wrong = {"odometry.scale": -0.04, "odometry.turn_scale": 0.07, "odometry.turn_bias": 0.003}
    wrong |= {"odometry.lateral_scale": -0.2}
    names, values = tuple(wrong), np.array(list(wrong.values()))
    whole = SharedErrors(Log("log", (), said), None, None, settings_of(), names, values, np.eye(4)).corrected_log(values)
    first, second = OdometryCorrection(wrong), None
    for i in range(250):
        at = first.correct(float(said.stamps[i]), said.poses[i])
        np.testing.assert_allclose(at, whole.odometry.poses[i], atol=1e-9)
    begun = (Trajectory(path.stamps[:250], path.poses[:250]) for path in (said, whole.odometry))
    second = OdometryCorrection(wrong, *begun)  # a calibration that takes effect in the middle
    for i in range(250, 400):
        np.testing.assert_allclose(second.correct(float(said.stamps[i]), said.poses[i]), whole.odometry.poses[i], atol=1e-9)


def test_errors_are_found_while_the_robot_drives_and_the_map_is_better_for_it(log, own_processes):
    session = drive(log, settings_of("live.calibrate_from=80"))
    snapshot = session.snapshot()
    session.abort()
    assert snapshot.counters["calibrations"] >= 1
    found = snapshot.calibration
    for name, true in ERRORS.items():
        at = found.names.index(name)
        assert abs(found.values[at] - true) < 3 * found.sigma[at], name
    without = drive(log, settings_of("live.calibrate_from=0"))
    plain = without.snapshot()
    assert plain.calibration is None
    assert rmse(snapshot.map, log) < 0.6 * rmse(plain.map, log)
    result = without.stop()
    assert result.calibration is not None  # the end estimates them in any case
    assert set(result.summary["calibration"]["parameters"]) >= set(ERRORS)
    turned = result.cameras[0].base_T_camera[:3, :3] @ log.cameras[0].camera.base_T_camera[:3, :3].T
    np.testing.assert_allclose(rotation_vector(turned)[2], ERRORS["front.yaw"], atol=0.01)  # It is corrected.


@pytest.fixture(scope="module")
def expected(log, patience, tmp_path_factory):
    """The last snapshot of a session that calibrates, and that nothing kills."""
    whole = drive(log, settings_of("live.calibrate_from=80"), journal=tmp_path_factory.mktemp("whole") / "journal")
    snapshot = whole.snapshot()
    whole.abort()
    return snapshot


@pytest.mark.parametrize("killed_at", ["before it takes effect", "after it took effect"])
def test_a_session_killed_around_a_calibration_goes_on_to_the_same_map(log, expected, tmp_path, killed_at):
    settings = settings_of("live.calibrate_from=80")
    session = Session(settings, tmp_path / "killed", patient=True).start()
    pushes = list(events(log))
    for number, push in enumerate(pushes):
        feed(session, log, number, pushes=[push])
        m = session._mapper.state
        if m.errors if killed_at.startswith("after") else m.next_id.keyframe >= 83:
            break
    assert bool(m.errors) == killed_at.startswith("after")
    session.abort()
    again = Session(settings, tmp_path / "killed", resume=True, patient=True).start()
    assert again._mapper.state.errors == m.errors
    feed(again, log, number + 1, pushes=pushes[number + 1 :])
    snapshot = again.snapshot()
    again.abort()
    assert snapshot.counters["calibrations"] == expected.counters["calibrations"]
    np.testing.assert_array_equal(snapshot.calibration.values, expected.calibration.values)
    assert [o.label for o in snapshot.map.objects] == [o.label for o in expected.map.objects]
    for one, other in zip(snapshot.map.objects, expected.map.objects, strict=True):
        np.testing.assert_allclose(one.position, other.position, atol=1e-6)


def test_a_session_starts_from_a_file_of_calibrate(log, file):
    session = drive(log, settings_of("live.calibrate_from=0", f"calibration.file={file}"))
    known = session.snapshot()
    session.abort()
    assert dict(zip(known.calibration.names, known.calibration.values.tolist(), strict=True)) == pytest.approx(ERRORS)
    clean = drive(simulated_without_errors(), settings_of("live.calibrate_from=0", "calibration.use=false"))
    best = rmse(clean.snapshot().map, log)
    clean.abort()
    assert rmse(known.map, log) < 1.5 * best + 0.01


def test_a_file_that_is_gone_in_the_end_costs_no_map(log, file, tmp_path):
    gone = tmp_path / "gone.yaml"
    gone.write_bytes(file.read_bytes())
    session = drive(log, settings_of("live.calibrate_from=0", f"calibration.file={gone}"))
    gone.unlink()
    result = session.stop()
    assert len(result.map.resolved()) >= 10
    assert any("the shared errors are not estimated" in line for line in result.summary["warnings"])


def simulated_without_errors():
    changes = {"frames": 200, "classes": 12, "false": 0.0, "localization": None, "odometry": QUIET, "depth": DepthNoise()}
    return simulate(preset("demo", **changes), 3)


def test_a_map_that_is_corrected_is_that_of_a_session_that_knew(log, file):
    late = drive(log, settings_of("live.calibrate_from=0"))
    late.abort()
    early = drive(log, settings_of("live.calibrate_from=0", f"calibration.file={file}"))
    early.abort()
    m, other = late._mapper.state, early._mapper.state
    m.pairs.apart[0, 1] = 3
    recalibrate(m, other.calibration, NOMINAL)
    assert not m.pairs.apart  # By the new noise, two objects that were apart may be one.
    _, at, there = np.intersect1d(m.keyframes.sent, other.keyframes.sent, return_indices=True)
    # A frame whose corrected stamp is beyond the odometry takes the pose of its end, which may still be on its way.
    known = other.keyframes.stamp[there] < other.course.odometry.newest - 0.2
    at, there = at[known], there[known]
    assert len(at) > 50
    for name in ("stamp", "base_T_camera", "map_T_base", "start_T_base", "camera_T_start", "drift"):
        np.testing.assert_allclose(getattr(m.keyframes, name)[at], getattr(other.keyframes, name)[there], atol=1e-6)
    np.testing.assert_allclose(
        m.course.odometry.at(m.course.odometry.newest).pose,
        other.course.odometry.at(other.course.odometry.newest).pose,
        atol=1e-6,
    )
    positions = {m.labels[label]: p for label, p in zip(m.landmarks.label, m.landmarks.position, strict=True)}
    for label, p in zip(other.landmarks.label.tolist(), other.landmarks.position, strict=True):
        np.testing.assert_allclose(positions[other.labels[label]], p, atol=0.03)


def test_ranges_and_focal_lengths_are_corrected_in_rays_that_came_before(log):
    session = drive(log, settings_of("live.calibrate_from=0"))
    session.abort()
    m = session._mapper.state
    before, direction = m.rays.range.copy(), m.rays.direction.copy()
    names = ("range_scale", "front.focal")
    for values in ([0.02, 0.05], [-0.01, 0.01]):
        recalibrate(m, Calibration(names, np.array(values), np.eye(2), np.ones(2)), NOMINAL)
        np.testing.assert_allclose(m.rays.range, before * (1 + values[0]), rtol=1e-9)
        longer = direction * [1, 1, 1 + values[1]]
        np.testing.assert_allclose(m.rays.direction, longer / np.linalg.norm(longer, axis=1, keepdims=True), atol=1e-9)


def test_the_sigmas_at_the_end_contain_a_focal_length_that_is_held(log):
    exact, usual = (drive(log, settings_of(*more)).stop().map.resolved() for more in (("calibration.focal=0",), ()))
    assert [one.label for one in exact] == [one.label for one in usual]
    grown = [np.trace(two.covariance) / np.trace(one.covariance) for one, two in zip(exact, usual, strict=True)]
    assert np.median(grown) > 1.02


def test_what_a_session_cannot_observe_stays_as_it_is():
    """Against conditioning by information: a Gauss function at a fixed value of the second parameter."""
    root = np.random.default_rng(1).normal(size=(3, 3)) * [0.3, 2.0, 0.3]
    covariance = root.T @ root
    found = Calibration(("a", "b", "c"), np.array([0.4, 2.0, -0.3]), covariance, np.array([5.0, 0.1, 5.0]))
    now = np.array([0.0, 0.5, 0.0])
    information = np.linalg.inv(covariance)
    others = [0, 2]
    shift = np.linalg.solve(information[np.ix_(others, others)], -information[others, 1] * (now[1] - 2.0))
    kept = observed(found, now)
    np.testing.assert_allclose(kept.values[others], found.values[others] + shift, rtol=1e-9)
    assert kept.values[1] == 0.5
    assert observed(replace(found, prior=np.full(3, 50.0)), now).values.tolist() == found.values.tolist()


def test_a_clock_that_may_be_right_delays_no_frame():
    """Against the mean square of the errors of draws from the posterior, about the values that the session takes."""
    names, rng = ("front.clock", "front.yaw"), np.random.default_rng(3)
    covariance = np.array([[0.04**2, 2e-4], [2e-4, 0.02**2]])

    def of(clock, sigma=0.1):
        return Calibration(names, np.array([clock, 0.01]), covariance, np.array([sigma, 0.05]))

    kept = observed(of(0.07), np.zeros(2))
    np.testing.assert_allclose(kept.values, [0.0, 0.01 - 0.07 * 2e-4 / 0.04**2], atol=1e-12)
    drawn = rng.multivariate_normal(of(0.07).values, covariance, 100_000) - kept.values
    np.testing.assert_allclose(kept.covariance, drawn.T @ drawn / len(drawn), rtol=0.03)
    for clock in (-0.03, 0.09):  # The first delays nothing, and the second is clearly behind.
        assert observed(of(clock), np.zeros(2)).values.tolist() == [clock, 0.01]
    assert observed(of(0.07), np.array([0.05, 0.0])).values[0] == 0


def test_frames_stop_waiting_for_a_clock_that_may_be_right():
    """An estimate within its noise of the present value ends the wait, although nothing else has changed."""
    session = Session(settings_of())
    calibrator = next(one for one in session._rounds if isinstance(one, Calibrator))
    found = Calibration(("front.clock", "front.yaw"), np.array([0.05, 0.01]), np.diag([0.04, 0.02]) ** 2, np.full(2, 0.1))
    for clock, wanted in ((0.07, True), (0.0, False)):
        session._mapper.state.errors.update({"front.clock": clock, "front.yaw": 0.01})
        message = calibrator._correction(200, (found, NOMINAL))
        assert (message is not None) == wanted
        assert message is None or message.calibration.values.tolist() == [0.0, 0.01]


def test_a_worker_that_fails_costs_no_frame(log, monkeypatch, own_processes):
    monkeypatch.setattr("objslam.live.worker.Worker._run", lambda self: self._process.kill())
    session = drive(log, settings_of("live.calibrate_from=80"))
    snapshot = session.snapshot()
    session.abort()
    assert snapshot.counters["calibrations given up"] >= 1
    assert "calibrations" not in snapshot.counters
    assert snapshot.counters["frames"] == 200
    assert session.failure is None


def test_a_frame_before_the_first_pose_is_on_the_same_clock(log):
    """A resumed session knows by how much the clock was set back, also for frames that come before its next pose."""
    from objslam.sources.journal.records import FrameMessage, NoteMessage

    heard = []
    session = Session(settings_of())
    session._deliver = lambda message, arrival: heard.append(message) or True
    session.recall(NoteMessage(100.0, np.eye(4)))
    assert session.push_camera(log.cameras[0].camera)
    assert session.push_detections(5.0, "front", np.zeros((0, 4)), [], np.zeros(0))
    assert [m.stamp for m in heard if isinstance(m, FrameMessage)] == [105.0]


@pytest.mark.parametrize("order", ["odometry that stops and comes back", "localisation first, and each stops in turn"])
def test_paths_that_stop_and_come_back_are_corrected(order, tmp_path):
    """The course is of several pieces, of odometry and of localisation. A calibration moves each of them."""
    clean = make_log(localization=PoseNoise(xy=0.02, yaw=0.005), depth=DepthNoise())
    log = add_shared_errors(clean, ERRORS)
    settings, pushes = settings_of("live.calibrate_from=40"), heard(log, *ORDERS[order])
    session = hear(log, pushes, settings, journal=tmp_path / "whole")
    snapshot = session.snapshot()
    assert snapshot.counters["calibrations"] >= 1
    assert snapshot.rebuilds == 0
    assert rmse(snapshot.map, log) < 0.1
    assert rmse(session.stop().map, log) < 0.1
    again = Session(settings, tmp_path / "whole", resume=True, patient=True).start()
    resumed = again.snapshot()
    again.abort()
    assert resumed.calibration.values.tolist() == snapshot.calibration.values.tolist()
    for one, other in zip(resumed.map.objects, snapshot.map.objects, strict=True):
        np.testing.assert_allclose(one.position, other.position, atol=1e-6)
