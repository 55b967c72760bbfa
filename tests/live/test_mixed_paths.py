"""Odometry and localisation that come, stop and come back in any order, against the truth of simulated drives."""

import json
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
from quick import HELD, NOTHING_DRAWN, options
from scipy.spatial.transform import Rotation
from test_session import errors, make_log
from waiting import LIMIT

from objslam.config import load_settings
from objslam.core.geometry import lift_se2
from objslam.core.trajectory import Trajectory
from objslam.io.results.read import load_map
from objslam.live.session.session import Session
from objslam.simulation import PoseNoise

SETTINGS = load_settings(None, ("mode=joint", "rays.pixel_sigma=2", *HELD))
"""Shared errors are held, because the bounds below are for paths. test_live_calibration.py estimates them on such paths."""
WHOLE, NEVER = ((0, 999),), ()
FRAMES = (lift_se2(np.array([3.0, -2.0, 0.8])), lift_se2(np.array([-1.0, 4.0, -2.0])))
"""Where each stretch of the odometry has its own beginning."""


@pytest.fixture(scope="module")
def log():
    return make_log(localization=PoseNoise(xy=0.02, yaw=0.005))


@pytest.fixture(scope="module")
def exact():
    return make_log(localization=PoseNoise())


def heard(log, odometry, localization, frames=FRAMES):
    """What a robot pushes, as (stamp, push). Each path has poses only in its intervals from begin to end, s."""
    begin = log.odometry.stamps[0]
    camera, detections = log.cameras[0].camera, log.cameras[0].detections
    said = []

    def pose(at, push, matrix):
        said.append((at, 0, lambda s: getattr(s, push)(at, matrix)))

    for path, when, push in (
        (log.localization, localization, "push_localization"),
        (log.odometry, odometry, "push_odometry"),
    ):
        for (first, last), own_T_odom in zip(when, frames if push == "push_odometry" else frames * 9, strict=False):
            for stamp, matrix in zip(path.stamps, path.poses, strict=True):
                if first <= stamp - begin <= last:
                    pose(float(stamp), push, own_T_odom @ matrix if push == "push_odometry" else matrix)
    for frame, stamp in enumerate(detections.frame_stamps.tolist()):
        mine = detections.frame == frame
        labels = [detections.label_names[i] for i in detections.label[mine]]
        boxes = (camera.name, detections.boxes[mine], labels, detections.scores[mine])
        said.append((stamp, 1, lambda s, stamp=stamp, boxes=boxes: s.push_detections(stamp, *boxes)))
    return [push for _, _, push in sorted(said, key=lambda one: one[:2])]


def drive(log, pushes, settings=SETTINGS, refused=0, **more):
    session = Session(settings, patient=True, **more).start()
    session.push_camera(log.cameras[0].camera)
    taken = 0
    for push in pushes:
        taken += push(session)
        assert session.wait(LIMIT)
        assert session.failure is None
    assert taken >= len(pushes) - refused, session.counters.dropped()
    return session


def mapped(session, begin, end):
    """How many keyframes there are between two times of the drive, s."""
    since = session.snapshot().path.stamps - 1.7e9
    return int(((since > begin) & (since < end)).sum())


ORDERS = {
    "localisation 0.4 s ahead of the odometry": (((0.4, 999),), WHOLE),
    "localisation 3 s ahead of the odometry": (((3, 999),), WHOLE),
    "localisation that stops and comes back": (WHOLE, ((0, 8), (18, 999))),
    "odometry that stops and comes back": (((0, 10), (20, 999)), WHOLE),
    "odometry that stops for good": (((0, 10),), WHOLE),
    "odometry that never comes": (NEVER, WHOLE),
    "odometry that comes at the end": (((27, 999),), WHOLE),
    "localisation first, and each stops in turn": (((4, 12), (20, 999)), ((0, 6), (10, 22), (26, 999))),
}


@pytest.mark.parametrize("order", ORDERS.values(), ids=ORDERS)
def test_the_map_is_right_whichever_path_comes_when(log, order, tmp_path):
    pushes = heard(log, *order)
    session = drive(log, pushes, journal=tmp_path / "whole")
    snapshot = session.snapshot()
    off = errors(snapshot.map, log)
    assert len(off) >= 10
    assert max(off.values()) < 0.1
    assert snapshot.rebuilds == 0
    assert snapshot.keyframes >= 75
    result = session.stop()
    off = errors(result.map, log)
    assert len(off) >= 10
    assert max(off.values()) < 0.06
    half = len(pushes) // 2
    drive(log, pushes[:half], journal=tmp_path / "killed").abort()
    session = Session(SETTINGS, tmp_path / "killed", resume=True, patient=True).start()
    for push in pushes[half:]:
        assert push(session)
        session.wait(LIMIT)
    again = session.snapshot()
    session.abort()
    assert [o.label for o in again.map.objects] == [o.label for o in snapshot.map.objects]
    for one, other in zip(again.map.objects, snapshot.map.objects, strict=True):
        np.testing.assert_allclose(one.position, other.position, atol=1e-6)


def test_exact_localisation_a_little_ahead_of_the_odometry(exact):
    session = drive(exact, heard(exact, ((0.4, 999),), WHOLE))
    assert session.snapshot().rebuilds == 0
    assert max(errors(session.stop().map, exact).values()) < 0.05


def test_a_session_maps_on_while_the_odometry_is_away(log):
    session = drive(log, heard(log, ((0, 10), (20, 999)), WHOLE))
    assert mapped(session, 10.2, 19.8) > 25
    assert not any(reason.startswith("frames") for reason in session.counters.dropped())
    session.abort()


@pytest.mark.parametrize(
    ("odometry", "localization"),
    [(((10.05, 999),), ((0, 10),)), (((0, 10),), ((10.05, 999),)), (((0, 10), (12, 999)), ((0, 10),))],
    ids=["localisation, then odometry", "odometry, then localisation", "a gap of the odometry alone"],
)
def test_paths_that_never_meet_are_tied_by_what_is_seen(log, odometry, localization):
    session = drive(log, heard(log, odometry, localization, FRAMES[:1] * 2))
    snapshot = session.snapshot()
    off = errors(snapshot.map, log)
    assert snapshot.rebuilds == 0
    assert len(off) >= 10
    assert max(off.values()) < 0.15
    result = session.stop()  # with the keyframes that the localisation covers, which are few
    sigma = {o.label: np.sqrt(np.linalg.eigvalsh(o.covariance)[-1]) for o in result.map.resolved()}
    assert all(miss < max(0.1, 3 * sigma[label]) for label, miss in errors(result.map, log).items())


def test_odometry_that_began_elsewhere_is_set_right_by_the_first_localisation():
    log = make_log(seed=1, frames=200, localization=PoseNoise(xy=0.02, yaw=0.005))
    session = drive(log, heard(log, ((0, 10), (12, 999)), ((20, 999),)))
    assert max(errors(session.snapshot().map, log).values()) < 0.1
    session.abort()


def test_objects_that_look_alike():
    log = make_log(seed=1, frames=250, classes=5, localization=PoseNoise(xy=0.02, yaw=0.005))
    session = drive(log, heard(log, ((3, 15), (28, 999)), WHOLE))
    assert not session._mapper.state.by_label
    snapshot = session.snapshot()
    assert snapshot.rebuilds == 0
    for found in (snapshot.map, session.stop().map):
        near = [min(np.linalg.norm(o.position - t.position) for t in log.truth.objects if t.label == o.label)
                for o in found.resolved()]  # fmt: skip
        assert len(near) >= 11
        assert max(near) < 0.1


def test_keyframes_left_out_leave_no_pose_without_a_hold(log):
    settings = load_settings(None, ("mode=joint", "rays.pixel_sigma=2", "live.max_keyframes=50"))
    order = ((2, 8), (12, 16), (20, 24), (26, 999)), ((0, 3), (7, 13), (15, 20.5), (23.5, 26.5))
    session = drive(log, heard(log, *order, FRAMES * 2), settings)
    snapshot = session.snapshot()
    session.abort()
    assert snapshot.counters["keyframes left out"] >= 30
    assert snapshot.rebuilds == 0
    off = errors(snapshot.map, log)
    assert len(off) >= 9
    assert max(off.values()) < 0.2


def test_one_stamp_of_the_localisation_far_ahead_does_not_stop_the_odometry(log):
    pushes = heard(log, WHOLE, WHOLE)
    stamp, pose = float(log.localization.stamps[50]) + 500.0, log.localization.poses[50]
    pushes.insert(600, lambda s: s.push_localization(stamp, pose))
    session = drive(log, pushes, refused=300)  # later localisations are late
    assert session.snapshot().keyframes >= 75
    session.abort()


def test_the_odometry_may_be_away_for_longer_than_a_frame_may_be_ahead(log):
    """Frames do not count as too far ahead of the path while the localisation goes on."""
    detections, slow = log.cameras[0].detections, 10.0

    def later(stamps):
        return stamps[0] + slow * (stamps - stamps[0])

    camera = replace(log.cameras[0], detections=replace(detections, frame_stamps=later(detections.frame_stamps)))
    slower = replace(
        log,
        cameras=(camera,),
        odometry=Trajectory(later(log.odometry.stamps), log.odometry.poses),
        localization=Trajectory(later(log.localization.stamps), log.localization.poses),
    )
    session = drive(slower, heard(slower, ((0, 50),), WHOLE))
    assert session.snapshot().keyframes >= 75
    session.abort()


def test_a_clock_set_back_while_the_odometry_is_away(log):
    """Meanwhile the localisation sets the clock, and the stamps of frames follow it."""
    pushes, stamps = heard(log, ((0, 8), (22, 999)), WHOLE), log.localization.stamps
    back = 5.0

    class Later:
        """The sink as the robot's clock has it from the middle of the drive on."""

        def __init__(self, session):
            self.session = session

        def __getattr__(self, name):
            def push(stamp, *rest):
                return getattr(self.session, name)(stamp - back * (stamp >= stamps[150]), *rest)

            return push

    session = drive(log, [lambda s, p=p: p(Later(s)) for p in pushes], refused=10)
    assert session.counters.accepted()["clock set back"] == 1
    snapshot = session.snapshot()
    assert snapshot.keyframes >= 73
    assert snapshot.rebuilds == 0
    assert max(errors(session.stop().map, log).values()) < 0.1


def line(kind, stamp, matrix):
    turn = Rotation.from_matrix(matrix[:3, :3]).as_quat().tolist()
    return {"type": kind, "stamp": stamp, "translation": matrix[:3, 3].tolist(), "rotation_xyzw": turn}


class Lines:
    """A sink that writes down what it is told as JSON lines."""

    def __init__(self):
        self.lines = []

    def push_odometry(self, stamp, pose):
        self.lines.append(line("odometry", stamp, pose))

    def push_localization(self, stamp, pose):
        self.lines.append(line("localization", stamp, pose))

    def push_detections(self, stamp, camera, boxes, labels, scores):
        columns = {"boxes": boxes.tolist(), "labels": labels, "scores": scores.tolist()}
        self.lines.append({"type": "detections", "camera": camera, "stamp": stamp, **columns})


def test_the_command_ends_with_a_result_and_resumes(exact, tmp_path):
    c = exact.cameras[0].camera
    sink = Lines()
    for push in heard(exact, ((0.4, 999),), WHOLE):
        push(sink)
    camera = {
        "type": "camera",
        "name": c.name,
        "image_width": c.width,
        "image_height": c.height,
        "camera_matrix": c.matrix.ravel().tolist(),
        "distortion_model": c.distortion_model,
        "distortion_coefficients": c.distortion.tolist(),
        "base_T_camera": {k: v for k, v in line("", 0, c.base_T_camera).items() if k not in ("type", "stamp")},
    }
    text = [json.dumps(one) for one in (camera, *sink.lines)]
    out, half = tmp_path / "out", len(text) // 2
    quiet = (*NOTHING_DRAWN, *HELD, "rays.pixel_sigma=2", "live.max_lag=1000")
    command = [sys.executable, "-m", "objslam", "live", "stdin", "-o", str(out)]
    command += options(*quiet)
    for more, part in (((), text[:half]), (("--resume",), text[half:])):
        done = subprocess.run([*command, *more], input="\n".join(part) + "\n", capture_output=True, text=True, timeout=LIMIT)
        assert done.returncode == 0, done.stderr
        assert "Traceback" not in done.stderr
    off = errors(load_map(out), exact)
    assert len(off) >= 11
    assert max(off.values()) < 0.05
