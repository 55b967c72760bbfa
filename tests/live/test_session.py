"""A session against the truth of simulated drives, and against what robots do to it."""

import threading
from dataclasses import replace
from itertools import count

import numpy as np
import pytest
from driving import feed
from quick import HELD
from robot import Recorder
from small_log import crowded
from waiting import LIMIT, pause

import objslam
from objslam.config import Odometry, load_settings
from objslam.core.camera import project
from objslam.core.diagnostics import Ledger
from objslam.core.geometry import align, inverse, lift_se2
from objslam.core.trajectory import Trajectory
from objslam.errors import SolveError
from objslam.evaluation.evaluate import evaluate
from objslam.frontend.bearings import build_rays
from objslam.frontend.boxes.nested_boxes import PARTS
from objslam.frontend.keyframes import build_keyframes
from objslam.graph.isam2 import IncrementalGraph
from objslam.live.adapters.replay import ReplayAdapter, events
from objslam.live.interface import Sink
from objslam.live.session.session import Session
from objslam.live.session.snapshots import Describer
from objslam.simulation import PoseNoise, make_camera, preset, simulate
from objslam.sources import read

DEFAULT = ("mode=joint", "rays.pixel_sigma=2")
ALL, SETTINGS = load_settings(None, DEFAULT), load_settings(None, (*DEFAULT, *HELD))
"""With ALL, a session estimates all that it can. Most tests look at its path, its messages or its counts."""


def make_log(seed=0, **changes):
    drive = {"frames": 150, "classes": 12, "false": 0.0, "localization": None, "odometry": Odometry(), **changes}
    return simulate(preset("demo", **drive), seed)


@pytest.fixture(scope="module")
def log():
    return make_log()


def drive(log, settings=SETTINGS, pushes=None, until=lambda: False, **more):
    return feed(Session(settings, patient=True, **more).start(), log, pushes=pushes, until=until)


def errors(found, log):
    """How far each object found is from the true one of its label; every label must be there at most once."""
    true = {o.label: o.position for o in log.truth.objects}
    names = [o.label for o in found.objects]
    assert len(names) == len(set(names))
    return {o.label: float(np.linalg.norm(o.position - true[o.label])) for o in found.resolved()}


def test_a_session_is_a_sink():
    sink: Sink = Session(SETTINGS)
    assert sink.push_odometry(1.0, np.eye(4)) is True


def test_the_map_is_right_while_the_robot_drives_and_in_the_end(log):
    session = drive(log, ALL)
    snapshot = session.snapshot()
    off = errors(snapshot.map, log)
    assert len(off) >= 10
    assert max(off.values()) < 0.15
    assert all(np.linalg.eigvalsh(o.covariance)[0] > 0 for o in snapshot.map.resolved())
    assert snapshot.keyframes == len(snapshot.path) > 70
    assert snapshot.counters["frames"] == 150
    assert 0 < snapshot.update[0] <= snapshot.update[1]
    result = session.stop()
    off = errors(result.map, log)
    assert len(off) >= 11
    assert max(off.values()) < 0.15
    assert result.summary["counts"]["detection_frames"] == 150
    assert len(result.path_after) == len(log.odometry)
    at = np.searchsorted(result.path_after.stamps, result.keyframes.stamps)
    off = result.path_after.poses[np.minimum(at, len(log.odometry) - 1), :3, 3] - result.map_T_base[:, :3, 3]
    assert np.linalg.norm(off, axis=1).max() < 0.1  # the next pose of the path: less than a step further
    assert len(result.rays) == len(result.weight) == len(result.association.object)
    assert session.snapshot().stamp == pytest.approx(result.keyframes.stamps.max())


@pytest.mark.parametrize("classes", [12, 3])
def test_an_object_keeps_its_id_to_the_end(classes):
    """An object has the same id in the last snapshot and in the result. With 3 labels, the end associates once more."""
    log = make_log(classes=classes)
    session = drive(log)
    shown = {o.id: o for o in session.snapshot().map.resolved()}
    end = session.stop().map.objects
    assert len({o.id for o in end}) == len(end)
    kept = [(shown[o.id], o) for o in end if o.id in shown]
    assert len(kept) >= 10
    if classes == 3:  # if the end numbered them again, they would have other ids
        assert [o.id for o in end] != list(range(len(end)))
    for before, after in kept:
        others = [o for o in end if o.label == before.label]
        assert min(others, key=lambda o: np.linalg.norm(o.position - before.position)) is after


def test_poses_that_the_settings_leave_unused_are_no_loss(log):
    """They are counted apart from what is dropped."""
    session = Session(load_settings(None, ("mode=joint", "poses.use=odometry")))
    assert not session.push_localization(1.0, np.eye(4))
    assert session.push_odometry(1.0, np.eye(4))
    assert session.counters.accepted() == {"localization not used": 1, "odometry": 1}
    assert not session.counters.dropped()


@pytest.mark.parametrize("budget", [1.5, 0.0])
def test_an_object_whose_covariance_is_not_computed_yet_is_not_surer_than_the_path(log, monkeypatch, budget):
    """The first snapshot of a map has time for one covariance of the graph, or for none. The rays alone know nothing of the
    path."""
    session = drive(log)
    state = session._mapper.state
    exact = {o.id: np.trace(o.covariance) for o in Describer().map(state, whole=True).resolved()}
    monkeypatch.setattr("objslam.live.session.snapshots._BUDGET", budget)
    monkeypatch.setattr("objslam.live.session.snapshots.time.perf_counter", lambda ticks=count(): float(next(ticks)))
    describer = Describer()
    describer._covariances[10**6] = np.zeros((3, 3))  # Of a landmark that has left the map.
    soon = {o.id: np.trace(o.covariance) for o in describer.map(state).resolved()}
    monkeypatch.undo()
    session.abort()
    assert len(soon) >= 10
    assert np.median([soon[j] / exact[j] for j in soon]) > 0.7


@pytest.mark.parametrize("share", [0.5, 0.01, 1e-4])
def test_the_status_is_asked_as_in_the_end(log, share):
    """If an object is too uncertain for its distance at the end, no snapshot called it resolved."""
    settings = load_settings(None, (*DEFAULT, *HELD, f"triangulation.max_rel_sigma={share}"))
    session = drive(log, settings)
    shown = {o.label: o for o in Describer().map(session._mapper.state, whole=True).objects}
    end = {o.label: o for o in session.stop().map.objects}
    both = [label for label in shown if label in end and shown[label].rays > 10]
    assert len(both) >= 10
    sure = [{label for label in both if objects[label].status == "ok"} for objects in (shown, end)]
    assert sure[0] <= sure[1]
    assert all((o.covariance is None) == (o.status != "ok") for o in shown.values())
    if share == 0.01:
        assert 0 < len(sure[0]) <= len(sure[1]) < len(both)
    else:
        assert sure[0] == sure[1] == (set(both) if share == 0.5 else set())


def test_a_snapshot_shows_what_each_camera_saw_last(log):
    session = drive(log)
    snapshot = session.snapshot()
    (frame,) = snapshot.frames
    assert frame.stamp == snapshot.stamp
    assert frame.camera.name == log.cameras[0].camera.name
    np.testing.assert_allclose(frame.map_T_camera @ inverse(frame.camera.base_T_camera), snapshot.path.poses[-1], atol=1e-9)
    place = {o.id: o.position for o in snapshot.map.objects}
    held = [(box, place[j]) for box, j, wrong in zip(frame.boxes, frame.objects.tolist(), frame.rejected, strict=True)
            if j >= 0 and not wrong]  # fmt: skip
    assert held
    boxes, places = np.array([box for box, _ in held]), np.array([p for _, p in held])
    local = (places - frame.map_T_camera[:3, 3]) @ frame.map_T_camera[:3, :3]
    off = project(frame.camera, local) - (boxes[:, :2] + boxes[:, 2:]) / 2
    assert np.median(np.linalg.norm(off, axis=1)) < 12  # px, from 2 px of noise and a position known to a few centimetres
    session.abort()


def test_several_objects_of_a_label():
    """By the session itself and at its end. The search beside a session has tests of its own (`test_reassociation`)."""
    log = simulate(preset("demo", frames=250), 1)
    found = drive(log).stop().map.resolved()
    true = [(o.label, o.position) for o in log.truth.objects]
    near = [min(np.linalg.norm(o.position - p) for label, p in true if label == o.label) for o in found]
    assert len(found) >= 11
    assert max(near) < 0.1


@pytest.fixture(scope="module")
def hall():
    """60 objects of 5 labels in 16 x 12 m: by dead reckoning the robot comes back metres beside where it was."""
    room = {"room": (16.0, 12.0), "path": (2, 3), "objects": 60, "classes": 5, "laps": None, "min_view_share": 0.01}
    rates = {"frames": 600, "frame_rate": 5.0, "odometry_rate": 50.0, "speed": 0.8}
    return simulate(preset("large", localization=None, odometry=Odometry(), **room, **rates), 5)


def test_a_loop_that_does_not_hold_leaves_all_as_it_was(hall, monkeypatch):
    from objslam.live.mapper import loop_closure

    close, same = loop_closure._close, list[bool]()

    def watched(m, *loop):
        before = m.landmarks.drift.copy(), m.landmarks.id.copy(), m.rays.owner.copy()
        close(m, *loop)
        same.append(
            all(np.array_equal(x, y) for x, y in zip(before, (m.landmarks.drift, m.landmarks.id, m.rays.owner), strict=True))
        )

    monkeypatch.setattr(loop_closure, "_close", watched)
    monkeypatch.setattr(loop_closure, "_NEAR", 0.0)  # none so small that it is closed without being asked
    monkeypatch.setattr(loop_closure, "_holds", lambda m, mine: False)
    drive(hall, load_settings(None, (*DEFAULT, *HELD, "live.search_from=0")), until=lambda: len(same) >= 3).abort()
    assert same
    assert all(same)


def test_a_hall_of_objects_that_look_alike_from_odometry_alone(hall):
    session = drive(hall, load_settings(None, (*DEFAULT, *HELD, "live.search_from=0")))  # A search would close loops, too.
    snapshot = session.snapshot()
    session.abort()
    found, true = snapshot.map.resolved(), hall.truth.objects
    place, there = np.array([o.position for o in found]), np.array([o.position for o in true])
    other = np.array([[o.label != t.label for t in true] for o in found])
    for _ in range(3):  # the map lies as the odometry began; laid onto the truth by what fits already
        gap = np.where(other, 99.0, np.linalg.norm(place[:, None] - there, axis=2))
        near = gap.min(axis=1) < 1.0
        pose, _ = align(place[near], there[gap.argmin(axis=1)[near]], "se2")
        place = place @ pose[:3, :3].T + pose[:3, 3]
    gap = np.where(other, 99.0, np.linalg.norm(place[:, None] - there, axis=2))
    assert (gap.min(axis=0) < 0.5).sum() >= 57
    assert len(found) <= 66
    assert snapshot.counters["loops closed"] >= 1


def test_a_crowd_of_one_label_does_no_harm():
    """9,900 boxes of a label in every tenth frame, in a room where labels do not tell objects apart."""
    log = simulate(preset("demo", frames=150), 1)
    session = drive(crowded(log, np.arange(0, 150, 10), 9_900))
    found = [o for o in session.stop().map.resolved() if o.label != "leaf"]
    dropped = session.counters.dropped()
    beyond = dropped["boxes beyond the 1000 surest of their label in a frame"]
    assert beyond + dropped[PARTS] == 15 * 8900  # A few boxes lie on others, as a second box of one thing does.
    assert session.counters.accepted()["tracks given up"] > 10 * 800  # most tracks do not become landmarks
    true = [(o.label, o.position) for o in log.truth.objects]
    near = [min(np.linalg.norm(o.position - p) for label, p in true if label == o.label) for o in found]
    assert len(found) >= 11
    assert max(near) < 0.15


def test_what_the_lens_cannot_see_is_not_missed():
    """A lens that folds back at 46 degrees: what lies 56 to 64 degrees off its axis would be projected into the image."""
    camera = make_camera(focal=500.0, distortion=(-0.3, 0.0, 0.0, 0.0, 0.0))
    cup, ball = np.array([3.1, 0.0, 0.3]), np.array([1.3, 2.2, 0.3])
    session = Session(SETTINGS).start()
    session.push_camera(camera)
    way = np.concatenate([np.linspace(-0.6, 0.6, 60), np.linspace(0.6, 0.15, 40), np.linspace(0.15, -0.35, 60)])
    turned = np.radians(np.concatenate([np.zeros(60), np.linspace(0.0, 60.0, 40), np.full(60, 60.0)]))
    for i, (y, yaw) in enumerate(zip(way, turned, strict=True)):
        stamp, pose = 0.2 * i, lift_se2(np.array([0.0, y, yaw]))
        session.push_odometry(stamp, pose)
        if 60 <= i < 100:  # it turns, and nobody looks
            continue
        local = np.array([cup, ball]) - (pose @ camera.base_T_camera)[:3, 3]
        local = local @ (pose @ camera.base_T_camera)[:3, :3]
        off = np.degrees(np.arctan2(np.hypot(local[:, 0], local[:, 1]), local[:, 2]))
        assert off[0] < 35 if i < 60 else 54 < off[0] < 66
        shown = off < 35
        middle = project(camera, local[shown])
        names = [name for name, there in zip(("cup", "ball"), shown.tolist(), strict=True) if there]
        session.push_detections(stamp, camera.name, np.hstack([middle - 15, middle + 15]), names, np.ones(len(names)))
        assert session.wait(LIMIT)
    landmarks = session._mapper.state.landmarks
    seen, expected = landmarks.seen.tolist(), landmarks.expected.tolist()
    session.abort()
    assert len(seen) == 2
    assert min(seen) > 20
    assert expected == seen


def localised_until(share, gap=None):
    """A log whose localisation ends after a share of the time. gap: the shares between which the odometry has a gap."""
    log = make_log(localization=preset("demo").localization)
    begin, end = log.localization.stamps[[0, -1]]
    kept = log.localization.stamps <= begin + share * (end - begin)
    log = replace(log, localization=Trajectory(log.localization.stamps[kept], log.localization.poses[kept]))
    if gap is None:
        return log
    at = (log.odometry.stamps - begin) / (end - begin)
    kept = (at < gap[0]) | (at > gap[1])
    return replace(log, odometry=Trajectory(log.odometry.stamps[kept], log.odometry.poses[kept]))


def test_keyframes_that_the_localisation_does_not_cover_are_counted():
    """The odometry does not continue the localisation across its own gap."""
    log = localised_until(0.4, gap=(0.45, 0.6))
    session = drive(log)
    result = session.stop()
    dropped = session.counters.dropped()
    lost = dropped["boxes that the localisation does not cover"]
    assert dropped["keyframes that the localisation does not cover"] > 10
    assert lost + result.summary["counts"]["rays"] == len(session._mapper.state.rays)
    assert log.localization.stamps[-1] < result.keyframes.stamps[-1] <= log.localization.stamps[-1] + 1.6
    assert result.summary["dropped"]["boxes that the localisation does not cover"] == lost


@pytest.mark.parametrize("share", [0.7, 0.02])
def test_the_odometry_continues_a_localisation_that_ends(share):
    log = localised_until(share)
    session = drive(log)
    result = session.stop()
    assert "boxes that the localisation does not cover" not in session.counters.dropped()
    assert result.summary["counts"]["rays"] == len(session._mapper.state.rays)
    found = evaluate(result.map, log.truth, align="none", radius=0.5).objects
    assert len(found.matches) >= 10
    assert np.sqrt((found.errors**2).mean()) < 0.15


def test_a_session_that_saw_too_little_for_an_object_ends_with_none():
    log = make_log()
    session = drive(log, pushes=list(events(log))[:3])
    result = session.stop()
    assert len(result.rays) > 0
    assert len(result.map) == 0


def test_where_the_second_solve_fails_the_first_one_counts(log, monkeypatch):
    from objslam.graph import batch_solver

    solve = batch_solver.solve_joint

    def only_from_a_start(*problem, start=None, **more):
        if start is None:
            raise SolveError("the graph does not grow")
        return solve(*problem, start=start, **more)

    session = drive(log)
    assert session._mapper.state.by_label
    monkeypatch.setattr(batch_solver, "solve_joint", only_from_a_start)
    assert max(errors(session.stop().map, log).values()) < 0.15


def test_localization_that_comes_late_moves_the_map():
    log = make_log(localization=preset("demo").localization)
    turned = lift_se2(np.array([5.0, -3.0, 1.0]))
    poses = [(s, turned @ p) for s, p in zip(log.localization.stamps, log.localization.poses, strict=True)]
    middle = poses[len(poses) // 3][0]
    session = Session(SETTINGS, patient=True).start()
    session.push_camera(log.cameras[0].camera)
    later = iter(p for p in poses if p[0] >= middle)
    following = next(later)
    for stamp, frame, push in events(replace(log, localization=None)):
        while following is not None and following[0] <= stamp:
            assert session.push_localization(*following)
            following = next(later, None)
        push(session)
        if frame:
            session.wait(LIMIT)
    true = {o.label: turned[:3, :3] @ o.position + turned[:3, 3] for o in log.truth.objects}
    found = session.snapshot().map.resolved()
    assert len(found) >= 10
    assert max(np.linalg.norm(o.position - true[o.label]) for o in found) < 0.15
    session.abort()


def test_localization_alone():
    log = make_log(odometry=None, localization=preset("demo").localization)
    off = errors(drive(log).stop().map, log)
    assert len(off) >= 10
    assert max(off.values()) < 0.15


def test_an_update_that_throws_leads_to_a_rebuild(log, monkeypatch):
    update, count = IncrementalGraph._update, [0]

    def throws(self, *how):
        count[0] += 1
        if count[0] in (30, 60):
            raise RuntimeError("Indeterminate linear system detected")
        update(self, *how)

    monkeypatch.setattr(IncrementalGraph, "_update", throws)
    session = drive(log)
    assert session.snapshot().rebuilds == 2
    off = errors(session.snapshot().map, log)
    assert len(off) >= 10
    assert max(off.values()) < 0.15
    session.abort()


def test_growth_is_bounded_and_the_map_stays(log):
    settings = load_settings(None, (*DEFAULT, *HELD, "live.max_keyframes=60"))
    session = drive(log, settings)
    snapshot = session.snapshot()
    assert len(snapshot.path) <= 70 < snapshot.keyframes
    off = errors(snapshot.map, log)
    assert len(off) >= 10
    assert max(off.values()) < 0.2
    session.abort()


def test_growth_is_bounded_where_objects_are_too_many_for_it(hall):
    """120 keyframes have about ten rays of each of 60 objects, which is fewer than the culling would keep."""
    settings = load_settings(None, (*DEFAULT, *HELD, "live.max_keyframes=120"))
    session = drive(hall, settings)
    snapshot = session.snapshot()
    session.abort()
    assert len(snapshot.path) <= 1.35 * 120
    assert snapshot.keyframes > 500
    assert 55 <= len(snapshot.map.resolved()) <= 65
    assert snapshot.counters["merged objects"] > 0  # the maintenance had time for other tasks


def test_what_was_pushed_in_disorder(log):
    rng = np.random.default_rng(0)
    pushes = list(events(log))
    at = np.arange(len(pushes)) + np.where(rng.random(len(pushes)) < 0.1, rng.integers(0, 20, len(pushes)), 0)
    mixed = [pushes[i] for i in np.argsort(at, kind="stable") for _ in range(2)]
    session = drive(log, pushes=mixed)
    dropped = session.counters.dropped()
    assert dropped["odometry that is late"] > 0
    assert dropped["odometry with a repeated stamp"] > 0
    assert dropped["frame with a repeated stamp"] == 150
    assert max(errors(session.stop().map, log).values()) < 0.15


@pytest.mark.parametrize("jump", [10.0, -10.0])
def test_a_clock_that_jumps_and_odometry_that_starts_anew(log, jump):
    odometry, detections, camera = log.odometry, log.cameras[0].detections, log.cameras[0].camera
    middle = odometry.stamps[len(odometry) // 2]
    reset = inverse(odometry.poses[np.searchsorted(odometry.stamps, middle) - 1])
    session = Session(SETTINGS, patient=True).start()
    session.push_camera(camera)
    frame = 0
    for stamp, pose in zip(odometry.stamps, odometry.poses, strict=True):
        after = stamp >= middle
        session.push_odometry(stamp + jump * after, reset @ pose if after else pose)
        while frame < len(detections.frame_stamps) and detections.frame_stamps[frame] <= stamp:
            at, mine = detections.frame_stamps[frame], detections.frame == frame
            labels = [detections.label_names[i] for i in detections.label[mine]]
            session.push_detections(
                at + jump * (at >= middle), camera.name, detections.boxes[mine], labels, detections.scores[mine]
            )
            session.wait(LIMIT)
            frame += 1
    accepted = session.counters.accepted()
    assert accepted["restarts of the odometry"] == 1
    assert accepted["clock set back" if jump < 0 else "gaps of the odometry"] == 1
    warned = [line for line in session.counters.ledger.warnings if line.startswith("the clock was set back by about 9.")]
    assert len(warned) == (jump < 0)
    off = errors(session.stop().map, log)
    assert len(off) >= 10
    assert max(off.values()) < 0.15


def test_rubbish_is_refused_and_counted(log):
    session = Session(SETTINGS, patient=True).start()
    camera, one = log.cameras[0].camera, np.ones(1)
    box = np.array([[10.0, 10.0, 30.0, 30.0]])
    assert not session.push_detections(1.0, "nobody", box, ["cup"], one)
    assert session.push_camera(camera)
    bad_poses = (np.full((4, 4), np.nan), 2 * np.eye(4), np.zeros((3, 3)), "pose", None)
    for pose in bad_poses:
        assert not session.push_odometry(1.0, pose)
        assert not session.push_localization(1.0, pose)
        assert not session.push_mount(1.0, camera.name, pose)
    assert not session.push_odometry(float("nan"), np.eye(4))
    assert not session.push_mount(1.0, "nobody", np.eye(4))
    assert not session.push_camera(replace(camera, matrix=np.zeros((3, 3))))
    for boxes, labels, scores in ((box, ["cup", "cup"], one), (box[:, :3], ["cup"], one), ("x", ["cup"], one)):
        assert not session.push_detections(1.0, camera.name, boxes, labels, scores)
    bad_boxes = np.array([[np.nan, 0, 1, 1], [5, 5, 4, 4], [0, 0, 9, 9], [0, 0, 9, 9]])
    assert session.push_detections(1.0, camera.name, bad_boxes, ["a", "b", "c", ""], [0.5, 0.5, 7.0, 0.5])
    assert session.counters.accepted().get("boxes", 0) == 0
    assert sum(n for reason, n in session.counters.dropped().items() if reason.startswith("box ")) == 4
    with pytest.raises(SolveError, match="no box could be mapped"):
        session.stop()


def test_too_many_frames_are_dropped_by_age_and_counted(log):
    """The first frame takes until all other frames have come and are too old."""
    settings = load_settings(None, ("mode=joint", "live.max_frames_waiting=2", "live.max_lag=0.05"))
    session, come = Session(settings), threading.Event()
    take = session._mapper.take
    session._mapper.take = lambda frame: come.wait(LIMIT) and take(frame)
    session.start()
    session.push_camera(log.cameras[0].camera)
    for _, _, push in events(log):
        push(session)
    pause(0.1)
    come.set()
    assert session.wait(LIMIT)
    dropped = session.counters.dropped()["frames that waited too long (live.max_lag)"]
    assert 149 <= dropped <= 150
    assert session.snapshot().keyframes <= 150 - dropped
    session.abort()


def test_a_patient_session_makes_the_source_wait_and_drops_nothing(log):
    """All messages at once, while only two frames may wait."""
    settings = load_settings(None, ("mode=joint", "live.max_frames_waiting=2", "live.max_lag=0.001"))
    with objslam.Session(settings, patient=True) as session:
        session.push_camera(log.cameras[0].camera)
        for _, _, push in events(log):
            push(session)
        assert session.wait(LIMIT)
        assert session.counters.accepted()["frames"] == 150
        assert not [reason for reason in session.counters.dropped() if "frames" in reason]


@pytest.mark.parametrize("early", [False, True])
def test_two_objects_of_a_label_that_no_frame_shows_together_are_two_in_the_end(monkeypatch, early):
    """early: whether the session finds them while the robot drives. Else each label is one object, and half of the rays do
    not fit."""
    if not early:
        monkeypatch.setattr("objslam.live.mapper.maintenance._second_objects", lambda *_: [])
    log = make_log(seed=1, classes=6)
    (camera,) = log.cameras
    boxes = camera.detections
    _, first = np.unique(np.stack([boxes.frame, boxes.label]), axis=1, return_index=True)
    log = replace(log, cameras=(replace(camera, detections=boxes.take(np.sort(first))),))
    session = drive(log)
    assert session._mapper.state.by_label != early
    found = session.stop().map.resolved()
    assert sorted(o.label for o in found) == sorted(o.label for o in log.truth.objects)
    true = [
        min((t for t in log.truth.objects if t.label == o.label), key=lambda t: np.hypot(*(t.position - o.position)[:2]))
        for o in found
    ]
    here, there = np.array([o.position for o in found]), np.array([t.position for t in true])
    pose, _ = align(here, there, "se2")
    assert np.linalg.norm(here @ pose[:3, :3].T + pose[:3, 3] - there, axis=1).max() < 0.2


def test_frames_that_come_seconds_late_find_their_place(log):
    pushes = list(events(log))
    late = [p for p in pushes if p[1]][::7]
    at = {id(p): p[0] + 1.5 for p in late}
    order = sorted(pushes, key=lambda p: at.get(id(p), p[0]))
    session = drive(log, pushes=order)
    assert session.counters.accepted()["frames out of order"] > 10
    assert "frame that is late (live.max_late)" not in session.counters.dropped()
    assert max(errors(session.stop().map, log).values()) < 0.15


def test_the_same_messages_make_the_same_map_and_a_killed_session_goes_on(log, tmp_path):
    whole = drive(log, journal=tmp_path / "whole")
    unbroken = whole.snapshot().map
    whole.abort()
    pushes = list(events(log))
    first = drive(log, journal=tmp_path / "journal", pushes=pushes[:500])
    first.abort()  # what a kill leaves is the same: every record is written before it counts
    with (tmp_path / "journal").open("ab") as stream:
        stream.write(b"\x40\x00\x00\x00half of a rec")
    session = Session(SETTINGS, tmp_path / "journal", resume=True, patient=True).start()
    assert session.counters.dropped()["torn record at the end of the journal"] == 1
    for _, frame, push in pushes[500:]:
        push(session)
        if frame:
            session.wait(LIMIT)
    again = session.snapshot().map
    assert [o.label for o in again.objects] == [o.label for o in unbroken.objects]
    for one, other in zip(again.objects, unbroken.objects, strict=True):
        np.testing.assert_allclose(one.position, other.position, atol=1e-6)
    session.abort()


def test_the_path_before_is_the_one_that_was_pushed(log):
    pushes = list(events(log))[:300]
    result = drive(log, pushes=pushes).stop()
    count = len(result.path)
    assert count > len(result.keyframes)
    np.testing.assert_array_equal(result.path.stamps, log.robot_path.stamps[:count])
    way = np.linalg.norm(np.diff(result.path.poses[:, :3, 3], axis=0), axis=1).sum()
    true = np.linalg.norm(np.diff(log.robot_path.poses[:count, :3, 3], axis=0), axis=1).sum()
    assert way == pytest.approx(true, rel=0.1)  # only the shared errors are taken out


@pytest.mark.parametrize("killed", [False, True])
def test_messages_that_come_again_change_nothing(log, tmp_path, killed):
    """A program that starts anew may send the last seconds again. They are no clock that was set back."""
    pushes = list(events(log))
    whole = drive(log, pushes=pushes)
    unbroken = whole.snapshot().map
    whole.abort()
    session = drive(log, journal=tmp_path / "journal", pushes=pushes[:500])
    if killed:
        session.abort()
        session = Session(SETTINGS, tmp_path / "journal", resume=True, patient=True).start()
    again = feed(session, log, pushes=pushes[200:])
    assert again.counters.accepted()["odometry that came before"] > 250
    assert "odometry that came before" not in again.counters.dropped()
    assert (again.counters.accepted().get("frames that came before", 0) > 30) == killed
    # Also the last messages of the journal are known.
    assert not (killed and any(reason.startswith(("frame", "odometry")) for reason in again.counters.dropped()))
    assert "clock set back" not in again.counters.accepted()
    assert "restarts of the odometry" not in again.counters.accepted()
    for one, other in zip(again.snapshot().map.objects, unbroken.objects, strict=True):
        np.testing.assert_allclose(one.position, other.position, atol=1e-6)
    again.abort()


def test_poses_that_are_rarer_than_frames_may_wait_are_named_as_the_cause(log):
    session = Session(load_settings(None, ("mode=joint", "live.max_lag=0.05"))).start()
    camera = log.cameras[0].camera
    session.push_camera(camera)
    for stamp in (0.0, 1.0):
        assert session.push_odometry(stamp, np.eye(4))
        assert session.push_detections(stamp + 0.5, camera.name, [[10, 10, 90, 90]], ["cup"], [1.0])
        pause(0.1)  # longer than live.max_lag
    assert session.push_odometry(2.0, np.eye(4))
    assert session.wait(LIMIT)
    session.abort()
    dropped = {reason: count for reason, count in session.counters.dropped().items() if reason.startswith("frames")}
    assert list(dropped.values()) == [2]
    assert "poses are too rare" in next(iter(dropped))
    assert "live.max_lag" in next(iter(dropped))


def test_a_recording_waits_for_its_rare_poses(log):
    rare = Trajectory(log.odometry.stamps[::25], log.odometry.poses[::25])
    slow = replace(log, odometry=rare)
    newest, seen = -np.inf, 0
    for at, frame, push in events(slow):
        sink = Recorder()
        push(sink)
        newest = max([newest, *(stamp for stamp, *_ in sink.odometry)])
        if frame and sink.detections[0][0] <= rare.stamps[-1]:
            seen += 1
            assert sink.detections[0][0] <= newest == at
    assert seen > 100


def test_fiducials_are_used_up_to_the_edge_as_offline(log, tmp_path):
    """A drive on which some boxes are at the image's edge: with `whole`, all of them are rays, live and from the journal."""
    front = log.cameras[0]
    corner = front.detections.boxes.copy()
    corner[::3] += [-1, 0, -1, 0] * corner[::3, :1]  # every third box begins at the left edge
    settings, used = load_settings(None, ("mode=joint", "live.keyframe_distance=0", *HELD)), {}  # It counts rays only.
    for whole in (False, True):
        (tmp_path / str(whole)).mkdir()
        cut = replace(log, cameras=(replace(front, detections=replace(front.detections, boxes=corner, whole=whole)),))
        session = drive(cut, settings, journal=tmp_path / str(whole) / "journal.objslam")
        session.abort()
        kept = read(tmp_path / str(whole), Ledger())
        assert kept.cameras[0].detections.whole == whole
        reason = "boxes cut off by the image's edge (rays.border, rays.border_share)"
        used[whole] = session.counters.dropped().get(reason, 0)
        for found in (cut, kept):
            offline = Ledger()
            build_rays(found, build_keyframes(found, settings, Ledger()), settings, offline)
            assert (offline.dropped.get(reason, 0) > 0) == (not whole)
    assert used[True] == 0
    assert used[False] >= len(corner[::3]) // 2


@pytest.mark.parametrize("ahead", [0.0, 0.3])
def test_the_journal_gives_the_same_rays_as_the_log(tmp_path, ahead):
    """The localisation is heard before the odometry of the same stamp, or is already further."""
    log = make_log(localization=PoseNoise(xy=0.02, yaw=0.005))
    first = log.localization
    session = Session(SETTINGS, tmp_path / "journal.objslam", patient=True).start()
    session.push_camera(log.cameras[0].camera)
    early = np.flatnonzero(first.stamps <= first.stamps[0] + ahead)
    for i in early.tolist():
        session.push_localization(float(first.stamps[i]), first.poses[i])
    for _, _, push in events(log):
        push(session)
    session.abort()
    kept = read(tmp_path, Ledger())
    np.testing.assert_array_equal(kept.odometry.stamps, log.odometry.stamps)
    one, other = (
        build_rays(found, build_keyframes(found, SETTINGS, Ledger()), SETTINGS, Ledger())
        for found in (replace(kept, localization=None), replace(log, localization=None))
    )
    np.testing.assert_array_equal(one.keyframe, other.keyframe)
    np.testing.assert_array_equal(one.direction, other.direction)


def test_replay_at_a_speed_and_stopped(log):
    stop = threading.Event()

    class Stopping(Recorder):
        def push_detections(self, *frame, **more):
            if len(self.detections) == 19:
                stop.set()
            return super().push_detections(*frame, **more)

    sink = Stopping()
    ReplayAdapter(sink, log, speed=20.0).run(stop)
    assert len(sink.detections) == 20


def test_two_things_of_a_label_that_no_frame_shows_together_are_two_before_the_end():
    log = make_log()
    camera, true = log.cameras[0], {o.label: o.position for o in log.truth.objects}
    found = camera.detections
    one, other = (found.label_names.index(name) for name in ("ball", "vase"))
    assert not set(found.frame[found.label == one]) & set(found.frame[found.label == other])
    boxes = replace(found, label=np.where(found.label == other, one, found.label))
    session = drive(replace(log, cameras=(replace(camera, detections=boxes),)))
    balls = [o.position for o in session.snapshot().map.resolved() if o.label == "ball"]
    session.abort()
    off = [[np.linalg.norm(place - true[name]) for place in balls] for name in ("ball", "vase")]
    assert len(balls) == 2
    assert max(map(min, off)) < 0.15


@pytest.mark.parametrize("changed", [True, False])
def test_a_camera_that_changes_in_mid_session_is_named(log, changed):
    pushes = list(events(log))
    camera = log.cameras[0].camera
    if changed:
        camera = replace(camera, width=camera.width // 2, height=camera.height // 2, matrix=camera.matrix / [[2], [2], [1]])
    middle = len(pushes) // 2
    again = (*pushes[middle - 1][:2], lambda sink: sink.push_camera(camera))
    result = drive(log, pushes=[*pushes[:middle], again, *pushes[middle:]]).stop()
    assert ("changed camera" in [one["name"] for one in result.summary["wrong_input"]]) == changed
    if changed:
        assert result.summary["assessment"]["level"] == "check"
