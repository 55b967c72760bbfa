"""Keyframes against closed forms, step-by-step propagation and simulated noise."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from objslam.config import Odometry, Settings
from objslam.core.camera import Camera
from objslam.core.diagnostics import Ledger
from objslam.core.geometry import adjoint, exp_se3, interpolate, inverse, lift_se2, log_se3, make_pose
from objslam.core.rotation import rotation_from_vector
from objslam.core.trajectory import Trajectory, correct_path
from objslam.core.types import CameraLog, Detections, Log
from objslam.errors import LogError
from objslam.frontend.corrected_odometry import ODOMETRY, CorrectablePath, corrected_odometry
from objslam.frontend.keyframes import build_keyframes
from objslam.frontend.odometry_drift import add_step, gathered_drift, step_drift
from objslam.graph.fixed_pose_triangulation import noise_of_poses

FIXED, JOINT = Settings(), Settings(mode="joint")
MATRIX = np.array([[500.0, 0, 320], [0, 500, 240], [0, 0, 1]])


def camera_log(name, stamps, boxes_per_frame=1, mount=None, place=None):
    stamps = np.asarray(stamps, dtype=float)
    frame = np.repeat(np.arange(len(stamps)), boxes_per_frame)
    m = len(frame)
    detections = Detections(
        frame_stamps=stamps,
        frame=frame,
        boxes=np.tile([300.0, 200, 340, 280], (m, 1)),
        label=np.zeros(m, dtype=np.int64),
        scores=np.ones(m),
        depths=np.full(m, np.nan),
        track_ids=np.full(m, -1),
        label_names=("cup",),
    )
    camera = Camera(name, 640, 480, MATRIX, base_T_camera=np.eye(4) if place is None else place)
    return CameraLog(camera, detections, mount=mount)


def line(stamps, speed=1.0, turn=0.2):
    """A path along an arc, closed form: at(t) of it is exact at every time, not only at the stamps."""
    stamps = np.asarray(stamps, dtype=float)
    return Trajectory(stamps, at(stamps, speed, turn))


def at(t, speed=1.0, turn=0.2):
    return exp_se3(np.multiply.outer(np.asarray(t, dtype=float), [0, 0, turn, speed, 0, 0]))


def test_frames_of_all_cameras_come_in_the_order_of_time():
    left, right = [0.5, 1.5, 2.5, 3.5], [0.1, 1.5, 3.4]
    places = [make_pose(np.eye(3), np.array([0.0, y, 0.0])) for y in (0.3, -0.3)]
    cameras = (camera_log("left", left, place=places[0]), camera_log("right", right, place=places[1]))
    ledger = Ledger()
    keyframes = build_keyframes(Log("log", cameras, odometry=line(np.arange(6))), FIXED, ledger)
    assert keyframes.stamps.tolist() == [0.1, 0.5, 1.5, 1.5, 2.5, 3.4, 3.5]
    assert keyframes.camera.tolist() == [1, 0, 0, 1, 0, 1, 0]
    assert keyframes.frame.tolist() == [0, 0, 1, 1, 2, 2, 3]
    for k, stamp in enumerate(keyframes.stamps):
        np.testing.assert_allclose(keyframes.map_T_base[k], at(stamp), atol=1e-12)
        np.testing.assert_array_equal(keyframes.base_T_camera[k], places[keyframes.camera[k]])
    np.testing.assert_allclose(keyframes.map_T_camera, keyframes.map_T_base @ keyframes.base_T_camera)
    assert not ledger.lines()


def tenths(low, high):
    return st.integers(low, high).map(lambda n: n / 10)


@given(
    st.lists(st.lists(tenths(-10, 90), max_size=12, unique=True).map(sorted), min_size=1, max_size=3),
    st.lists(tenths(0, 80), min_size=2, max_size=9, unique=True).map(sorted),
)
def test_every_frame_is_kept_in_place_or_counted(frames, path_stamps):
    cameras = tuple(camera_log(str(i), stamps, 2) for i, stamps in enumerate(frames))
    ledger, path = Ledger(), line(path_stamps)
    total = sum(map(len, frames))
    log = Log("log", cameras, localization=path)
    on_path = interpolate(path.stamps, path.poses, np.concatenate(frames), FIXED.poses.max_gap)[1].sum()
    if not on_path:
        with pytest.raises(LogError, match="none of the" if total else "no detection frames"):
            build_keyframes(log, FIXED, ledger)
        return
    keyframes = build_keyframes(log, FIXED, ledger)
    assert len(keyframes) == on_path
    dropped = sum(n for reason, n in ledger.dropped.items() if reason.startswith("frames"))
    assert len(keyframes) + dropped == total
    assert sum(n for reason, n in ledger.dropped.items() if reason.startswith("boxes")) == 2 * dropped
    assert (np.diff(keyframes.stamps) >= 0).all()
    assert keyframes.stamps[0] >= path.stamps[0]
    assert keyframes.stamps[-1] <= path.stamps[-1]
    for k, (camera, frame) in enumerate(zip(keyframes.camera, keyframes.frame, strict=True)):
        assert keyframes.stamps[k] == frames[camera][frame]
    np.testing.assert_allclose(keyframes.map_T_base, at(keyframes.stamps), atol=1e-9)


def test_frames_off_the_path_are_dropped_with_their_boxes():
    stamps = [0.0, 1.0, 1.5, 3.0, 4.6, 5.0, 6.0, 7.0]  # the path: 1 to 2, then a gap, then 5 to 6
    cameras = (camera_log("front", stamps, 3),)
    ledger = Ledger()
    keyframes = build_keyframes(Log("log", cameras, localization=line([1, 2, 5, 6])), FIXED, ledger)
    assert keyframes.stamps.tolist() == [1.0, 1.5, 5.0, 6.0]
    assert ledger.dropped == {
        "boxes before or after the localisation": 6,
        "frames before or after the localisation": 2,
        "boxes in a gap of the localisation": 6,
        "frames in a gap of the localisation": 2,
    }
    assert "stamp 3.000" in ledger.lines()[3]


def test_a_longer_max_gap_bridges_the_gap():
    ledger = Ledger()
    log = Log("log", (camera_log("front", [1.5, 3.0]),), localization=line([1, 2, 5, 6]))
    keyframes = build_keyframes(log, Settings.model_validate({"poses": {"max_gap": 3.0}}), ledger)
    np.testing.assert_allclose(keyframes.map_T_base, at([1.5, 3.0]), atol=1e-12)
    assert not ledger.lines()


@pytest.mark.parametrize("stamps", [[8.0, 9.0], [-2.0, -1.0], [3.0, 4.0]])
def test_nothing_is_extrapolated(stamps):
    ledger = Ledger()
    log = Log("the log", (camera_log("front", stamps),), localization=line([0, 1, 6, 7]))
    with pytest.raises(LogError, match=r"the log: none of the 2 detection frames lies on the robot's path .*0.000 to 7.000"):
        build_keyframes(log, FIXED, ledger)
    assert sum(ledger.dropped.values()) == 4


@pytest.mark.parametrize(
    ("frames", "path", "hint"),
    [
        ([8.0, 9.0], [0, 1, 6, 7], "same clock"),
        ([3.0, 4.0], [0, 1, 6, 7], "1 s apart: raise poses.max_gap"),
        ([3.0, 4.0], [0, 5, 10], "5 s apart: raise poses.max_gap"),
    ],
)
def test_the_hint_says_whether_frames_lie_outside_the_path_or_in_its_gaps(frames, path, hint):
    log = Log("the log", (camera_log("front", frames),), localization=line(path))
    with pytest.raises(LogError) as caught:
        build_keyframes(log, FIXED, Ledger())
    assert hint in caught.value.hint


def test_no_path_and_no_detections_are_log_errors():
    with pytest.raises(LogError, match="neither odometry nor localisation"):
        build_keyframes(Log("log", (camera_log("front", [1.0]),)), FIXED, Ledger())
    bare = CameraLog(Camera("front", 640, 480, MATRIX))
    for cameras in ((bare,), (camera_log("front", []),), ()):
        with pytest.raises(LogError, match="no detection frames"):
            build_keyframes(Log("log", cameras, odometry=line([0, 1])), FIXED, Ledger())


def test_a_camera_without_detections_is_no_harm():
    cameras = (CameraLog(Camera("blind", 640, 480, MATRIX)), camera_log("front", [0.5]))
    keyframes = build_keyframes(Log("log", cameras, odometry=line([0, 1])), JOINT, Ledger())
    assert keyframes.camera.tolist() == [1]


def test_a_moving_mount_places_the_camera_at_each_frame():
    swing = np.array([0.0, 0, 0.5, 0, 0.2, 0])
    mount = Trajectory(np.arange(5.0), exp_se3(np.multiply.outer(np.arange(5.0), swing)))
    cameras = (camera_log("arm", [0.5, 1.25, 3.5, 4.5, 5.5], 2, mount=mount), camera_log("front", [1.25, 5.5]))
    ledger = Ledger()
    keyframes = build_keyframes(Log("log", cameras, odometry=line(np.arange(7))), FIXED, ledger)
    assert keyframes.stamps.tolist() == [0.5, 1.25, 1.25, 3.5, 5.5]
    assert keyframes.camera.tolist() == [0, 0, 1, 0, 1]
    expected = np.where(
        (keyframes.camera == 0)[:, None, None], exp_se3(np.multiply.outer(keyframes.stamps, swing)), np.eye(4)
    )
    np.testing.assert_allclose(keyframes.base_T_camera, expected, atol=1e-12)
    assert ledger.dropped == {
        "boxes before or after the camera_poses of arm": 4,
        "frames before or after the camera_poses of arm": 2,
    }


def test_a_frame_is_counted_once_however_many_paths_it_misses():
    mount = Trajectory(np.arange(2.0, 5.0), np.tile(np.eye(4), (3, 1, 1)))
    log = Log(
        "log",
        (camera_log("arm", [0.0, 1.5, 2.5, 3.5, 9.0], 2, mount=mount),),
        odometry=line(np.arange(2.0, 4.0)),
        localization=line(np.arange(1.0, 5.0)),
    )
    ledger = Ledger()
    assert build_keyframes(log, JOINT, ledger).stamps.tolist() == [2.5]
    assert sum(n for reason, n in ledger.dropped.items() if reason.startswith("frames")) == 4
    assert sum(n for reason, n in ledger.dropped.items() if reason.startswith("boxes")) == 8


def test_localisation_is_the_path_and_odometry_the_motion():
    truth, drifted = line(np.arange(0, 6, 0.5)), line(np.arange(1.0, 8.0), speed=1.1, turn=0.25)
    log = Log("log", (camera_log("front", [0.5, 1.5, 2.25, 5.25, 5.75, 7.0]),), odometry=drifted, localization=truth)
    ledger = Ledger()
    fixed = build_keyframes(log, FIXED, ledger)
    assert fixed.stamps.tolist() == [0.5, 1.5, 2.25, 5.25]  # fixed mode has no use for odometry beside localisation
    assert fixed.odom_T_base is None
    assert fixed.drift is None
    joint = build_keyframes(log, JOINT, ledger := Ledger())
    assert joint.stamps.tolist() == [1.5, 2.25, 5.25]
    assert ledger.dropped["frames before or after the odometry"] == 1
    np.testing.assert_allclose(joint.map_T_base, at(joint.stamps), atol=1e-12)
    np.testing.assert_allclose(joint.odom_T_base, inverse(drifted.poses[0]) @ at(joint.stamps, 1.1, 0.25), atol=1e-12)
    np.testing.assert_allclose(joint.drift, gathered_drift(drifted, joint.stamps, Odometry()))


def test_a_gap_of_the_odometry_measures_no_motion_where_the_localisation_holds():
    stamps = np.array([*np.arange(0.0, 3.0, 0.5), *np.arange(6.0, 9.0, 0.5)])
    camera = camera_log("front", [0.2, 1.0, 2.5, 4.0, 6.0, 7.3])
    log = Log("log", (camera,), odometry=line(stamps), localization=line(np.arange(0, 10, 0.5)))
    keyframes = build_keyframes(log, JOINT, Ledger())
    assert keyframes.stamps.tolist() == [0.2, 1.0, 2.5, 6.0, 7.3]
    assert keyframes.stretch.tolist() == [0, 0, 0, 1, 1]
    assert keyframes.measured.tolist() == [True, True, False, True]
    assert keyframes.take(np.array([0, 4])).measured.tolist() == [False]
    alone = build_keyframes(replace(log, localization=None), JOINT, Ledger())
    assert alone.measured.tolist() == [True] * 4  # nothing else tells
    assert build_keyframes(replace(log, odometry=None), JOINT, Ledger()).measured.tolist() == [False] * 5


def test_odometry_alone_is_both():
    log = Log("log", (camera_log("front", [1.5, 3.25]),), odometry=line(np.arange(1.0, 8.0)))
    keyframes = build_keyframes(log, JOINT, Ledger())
    assert keyframes.localized_every == 0
    np.testing.assert_allclose(keyframes.map_T_base, at([1.5, 3.25]), atol=1e-12)
    np.testing.assert_allclose(keyframes.odom_T_base, inverse(at(1.0)) @ at([1.5, 3.25]), atol=1e-12)


@pytest.mark.parametrize(("rate", "expected"), [(0.5, 20.0), (5.0, 2.0), (10.0, 1.0), (50.0, 1.0)])
def test_localized_every_says_how_many_keyframes_share_a_pose(rate, expected):
    log = Log("log", (camera_log("front", 5 + np.arange(200) / 10),), localization=line(np.arange(0, 40 + 1e-9, 1 / rate)))
    settings = Settings.model_validate({"poses": {"max_gap": 3}})
    assert build_keyframes(log, settings, Ledger()).localized_every == pytest.approx(expected, rel=0.1)


@pytest.mark.parametrize(
    ("turns", "expected"), [([0], 1.0), ([0, 0], 1.0), ([0, 90, 180, 270], 0.25), ([0, 0, 180, 180], 0.5)]
)
def test_overlap_is_the_share_of_the_cameras_that_see_the_same(turns, expected):
    """Cameras that look to one side, or to sides that do not overlap. Ten images a second of each, and ten poses."""
    stamps = 5 + np.arange(200) / 10
    mounts = [make_pose(rotation_from_vector(np.radians([0.0, float(turn), 0.0])), np.zeros(3)) for turn in turns]
    log = Log(
        "log",
        tuple(camera_log(f"camera{number}", stamps, place=mount) for number, mount in enumerate(mounts)),
        localization=line(np.arange(0, 40 + 1e-9, 0.1)),
    )
    keyframes = build_keyframes(log, Settings(), Ledger())
    assert keyframes.overlap == pytest.approx(expected)
    # Of the images that share a measured pose, those of the cameras that see the same thing share its error for this thing.
    beside = max(len(turns) * expected, 1.0)
    assert noise_of_poses(keyframes, Settings())[1] == pytest.approx(0.02 * np.sqrt(beside), rel=0.05)


NOISY = Odometry(x_per_m=0.03, y_per_m=0.01, xy_per_rad=0.02, yaw_per_m=0.02, yaw_per_rad=0.04)


def twists(n=40, seed=0):
    """Steps of a bending planar drive, now and then on the spot."""
    rng = np.random.default_rng(seed)
    steps = np.zeros((n, 6))
    steps[:, 2], steps[:, 3] = rng.normal(0.05, 0.15, n), rng.uniform(0, 0.3, n)
    steps[::7, 3] = 0
    return steps


def chain(steps):
    poses = [np.eye(4)]
    for step in exp_se3(steps):
        poses.append(poses[-1] @ step)
    return np.array(poses)


def between(drift, poses, i, j):
    """The covariance (6, 6), in base at j, that the gathered drift gives the motion from i to j."""
    back = adjoint(inverse(poses[j]))
    return back @ (drift[j] - drift[i]) @ back.T


def step_noise(steps, noise=NOISY):
    turn, way = np.abs(steps[:, 2]), np.abs(steps[:, 3])
    zero = np.zeros(len(steps))
    x = noise.x_per_m**2 * way + noise.xy_per_rad**2 * turn
    y = noise.y_per_m**2 * way + noise.xy_per_rad**2 * turn
    return np.stack([zero, zero, noise.yaw_per_m**2 * way + noise.yaw_per_rad**2 * turn, x, y, zero], axis=1)


@pytest.mark.parametrize(("i", "j"), [(0, 40), (10, 11), (7, 33)])
def test_drift_is_what_noisy_steps_scatter(i, j):
    """Monte Carlo: 4,000 drives with noise on every step, whose relative pose i to j scatters about the true one."""
    steps, samples = twists(), 4000
    rng = np.random.default_rng(5)
    sigma = np.sqrt(step_noise(steps))
    relative = np.tile(np.eye(4), (samples, 1, 1))
    for step, s in zip(exp_se3(steps[i:j]), sigma[i:j], strict=True):
        relative = relative @ step @ exp_se3(rng.normal(size=(samples, 6)) * s)
    poses = chain(steps)
    error = log_se3(inverse(inverse(poses[i]) @ poses[j]) @ relative)
    simulated = np.cov(error.T)
    stamps = np.arange(41.0)
    predicted = between(gathered_drift(Trajectory(stamps, poses), stamps, NOISY), poses, i, j)
    planar = np.ix_([2, 3, 4], [2, 3, 4])
    # whitened by the prediction the scatter is the identity: 4,000 samples know it to 2 %, second order adds a little
    root = np.linalg.cholesky(predicted[planar])
    white = np.linalg.solve(root, np.linalg.solve(root, simulated[planar]).T)
    np.testing.assert_allclose(white, np.eye(3), atol=0.12)
    np.testing.assert_allclose(predicted[[0, 1, 5]], 0, atol=1e-15)


@pytest.mark.parametrize("seed", range(3))
def test_drift_is_the_covariance_propagated_step_by_step(seed):
    steps = twists(seed=seed)
    poses, noise = chain(steps), step_noise(steps)
    stamps = np.arange(41.0)
    drift = gathered_drift(Trajectory(stamps, poses), stamps, NOISY)
    i, covariance = 12, np.zeros((6, 6))
    for k in range(i, 40):
        # the pose so far, seen from the next base, carries its error over by the adjoint; the step adds its own
        carry = adjoint(inverse(exp_se3(steps[k : k + 1])[0]))
        covariance = carry @ covariance @ carry.T + np.diag(noise[k])
        np.testing.assert_allclose(between(drift, poses, i, k + 1), covariance, atol=1e-12)
    # the lever arm: 1 rad of heading error so far back moves the robot by the distance driven since
    straight = np.zeros((10, 6))
    straight[:, 3] = 1.0
    only_yaw = Odometry(x_per_m=0, y_per_m=0, xy_per_rad=0, yaw_per_m=0.01, yaw_per_rad=0)
    way = chain(straight)
    ten = between(gathered_drift(Trajectory(np.arange(11.0), way), np.arange(11.0), only_yaw), way, 0, 10)
    assert ten[4, 4] == pytest.approx(0.01**2 * (np.arange(10) ** 2).sum())
    assert ten[2, 2] == pytest.approx(10 * 0.01**2)


@pytest.mark.parametrize("errors", [(0.0,) * 6, (0.04, *(0.0,) * 5), (-0.03, -0.07, 0.002, 0.03, 0.04, -0.2)])
def test_the_drift_of_a_corrected_path_is_that_of_its_steps(errors):
    """The path is planar, so its drift comes from sums in the plane. The reference propagates the noise of each step."""
    rng = np.random.default_rng(2)
    steps = rng.normal(scale=[0.1, 0.02, 0.2], size=(40, 3)).cumsum(axis=0)
    odometry = Trajectory(np.arange(40.0), lift_se2(steps))
    error = dict(zip(ODOMETRY, errors, strict=True))
    corrected, path = corrected_odometry(odometry, error), CorrectablePath(odometry)
    start_T_base = inverse(corrected.poses[0]) @ corrected.poses
    expected = np.cumsum(step_drift(start_T_base, NOISY, planar=True), axis=0)
    np.testing.assert_allclose(path.drift(error).gathered(odometry.stamps[1:], NOISY), expected, atol=1e-12)


def test_drift_does_not_depend_on_the_rate_nor_on_where_the_odometry_starts():
    slow, fast = line(np.arange(0, 10.1, 0.25)), line(np.arange(0, 10.001, 0.01))
    moved = Trajectory(slow.stamps, lift_se2(np.array([30.0, -20, 2])) @ slow.poses)
    stamps = np.array([0.0, 2.5, 10.0])
    a, b, c = (gathered_drift(path, stamps, NOISY) for path in (slow, fast, moved))
    np.testing.assert_allclose(a, c, atol=1e-9)
    # a step has its noise at its end: half a step of lever arm is the difference
    at_end = adjoint(inverse(at(10.0)))
    a, b = (np.diag(at_end @ d[2] @ at_end.T)[[2, 3, 4]] for d in (a, b))
    np.testing.assert_allclose(a, b, rtol=0.06)


def test_drift_between_two_stamps_grows_evenly_and_stays_outside():
    path = line(np.arange(0.0, 3.0))
    drift = gathered_drift(path, np.array([-1.0, 0.0, 1.0, 1.25, 2.0, 5.0]), NOISY)
    np.testing.assert_allclose(drift[0], 0)
    np.testing.assert_allclose(drift[1], 0)
    np.testing.assert_allclose(drift[3], 0.75 * drift[2] + 0.25 * drift[4])
    np.testing.assert_allclose(drift[5], drift[4])
    single = Trajectory(np.array([3.0]), np.eye(4)[None])
    np.testing.assert_array_equal(gathered_drift(single, np.array([3.0, 4.0]), NOISY), np.zeros((2, 6, 6)))


def test_drift_of_a_path_in_space_has_all_six():
    steps = twists()
    steps[:, 0] = 0.02
    poses, stamps = chain(steps), np.arange(41.0)
    drift = gathered_drift(Trajectory(stamps, poses), stamps, NOISY)
    assert (np.linalg.eigvalsh(between(drift, poses, 0, 40)) > 1e-6).all()


@given(hnp.arrays(np.float64, (2, 6), elements=st.floats(-3, 3)), st.booleans())
def test_one_step_adds_what_it_adds_among_many(twist, planar):
    if planar:
        twist[:, [0, 1, 5]] = 0
    poses, before = exp_se3(twist), np.arange(36.0).reshape(6, 6)
    for after in (poses[1], poses[0]):  # a step, and none
        expected = before + step_drift(np.stack([poses[0], after]), NOISY, planar)[0]
        np.testing.assert_allclose(add_step(before, poses[0], after, NOISY, planar), expected, atol=1e-12)
    assert (before == np.arange(36.0).reshape(6, 6)).all()


def test_a_corrected_path_moves_as_its_keyframes_did():
    path = line(np.arange(0, 10.01, 0.1))
    stamps = np.array([2.0, 2.0, 4.0, 7.0])
    correction = lift_se2(np.array([[0.1, 0, 0.02], [0.1, 0, 0.02], [0.4, -0.2, 0.1], [0.5, 0.1, -0.1]]))
    after = correct_path(path, stamps, at(stamps), correction @ at(stamps))
    np.testing.assert_array_equal(after.stamps, path.stamps)
    for k, stamp in enumerate(stamps):
        index = round(stamp * 10)
        np.testing.assert_allclose(after.poses[index], correction[k] @ at(stamp), atol=1e-9)
    np.testing.assert_allclose(after.poses[:20], correction[0] @ path.poses[:20], atol=1e-9)  # before the first it stays
    np.testing.assert_allclose(after.poses[71:], correction[3] @ path.poses[71:], atol=1e-9)
    # and in between it goes over evenly, without a jump
    moved = log_se3(inverse(after.poses @ inverse(path.poses))[:-1] @ (after.poses @ inverse(path.poses))[1:])
    assert np.linalg.norm(moved, axis=1).max() < 0.03
    np.testing.assert_allclose(moved[21:39], np.tile(moved[30], (18, 1)), atol=1e-9)


def test_a_corrected_path_of_one_keyframe_moves_as_a_whole():
    path, move = line(np.arange(5.0)), lift_se2(np.array([1.0, 2, 0.5]))
    after = correct_path(path, np.array([2.0]), at([2.0]), move @ at([2.0]))
    np.testing.assert_allclose(after.poses, move @ path.poses, atol=1e-12)


def test_taken_keyframes_keep_what_belongs_together():
    log = Log("log", (camera_log("front", np.arange(1, 7, 0.5)),), odometry=line(np.arange(8.0)))
    keyframes = build_keyframes(log, JOINT, Ledger())
    some = keyframes.take(np.array([1, 4, 5]))
    assert some.localized_every == keyframes.localized_every
    np.testing.assert_array_equal(some.drift, keyframes.drift[[1, 4, 5]])
    np.testing.assert_array_equal(some.odom_T_base, keyframes.odom_T_base[[1, 4, 5]])
    assert replace(some, localized_every=2.0).stamps.tolist() == [1.5, 3.0, 3.5]
