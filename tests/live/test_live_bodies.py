"""Bodies in the snapshots of a running session, and the process beside the session that fits them."""

import threading
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from driving import feed
from mapping.body_drives import drive
from waiting import wait_for

from objslam.config import load_settings
from objslam.core.geometry import lift_se2
from objslam.evaluation.evaluate import evaluate
from objslam.live.adapters.replay import ReplayAdapter, events
from objslam.live.bodies.description import BodyEstimator
from objslam.live.bodies.request import BodyRequest
from objslam.live.session.session import Session
from objslam.live.worker import Worker

ALONE = ("calibration.use=false", "checks.use=false", "noise.localization=false", "live.search_from=0")
"""Bodies of a session depend on none of these."""


@pytest.fixture(scope="module")
def log():
    return drive(1)


def session_of(log, *changes):
    """A session that has mapped a whole log and still runs."""
    session = Session(load_settings(None, (*ALONE, *changes)), patient=True).start()
    ReplayAdapter(session, log, None, session.wait).run(threading.Event())
    return session


def sized(session, least):
    """The objects with a body in a new snapshot, None if there are fewer than `least`."""
    found = [o for o in session.snapshot().map if o.body is not None]
    return found if len(found) >= least else None


def test_a_snapshot_has_the_bodies_of_its_objects(log, monkeypatch):
    """With a localisation: sizes near the true ones, and centres of bodies nearer to the truth than where rays meet.

    The first snapshot has the time to describe all objects, so that one fit has all of them.
    """
    monkeypatch.setattr("objslam.live.session.snapshots._BUDGET", np.inf)
    session = session_of(replace(log, localization=log.truth.trajectory))
    found = wait_for(partial(sized, session, 5))
    result = session.stop()
    things = {o.label: o for o in log.truth.objects}
    ratio = np.array([np.sort(o.body.size) / np.sort(things[o.label].size) for o in found])
    assert np.median(np.abs(ratio - 1)) < 0.15
    moved = [o for o in found if o.ray_point is not None]
    assert len(moved) >= 2
    off, before = (
        np.array([getattr(o, name) - things[o.label].position for o in moved]) for name in ("position", "ray_point")
    )
    assert np.median(np.linalg.norm(off, axis=1)) < 0.7 * np.median(np.linalg.norm(before, axis=1))
    squared = np.einsum("ni,nij,nj->n", off, np.linalg.inv([o.covariance for o in moved]), off)
    assert np.mean(squared < 7.815) >= 0.75
    assert {o.id for o in found} <= {o.id for o in result.map}


def test_a_process_that_fails_leaves_points_and_is_not_asked_again(log, monkeypatch):
    asked = []
    monkeypatch.setattr(Worker, "_run", lambda self: asked.append(len(self._waiting)))
    monkeypatch.setattr("objslam.live.bodies.description._REST", 0.0)
    session = session_of(log)
    for _ in range(20):
        assert not sized(session, 1)
    session.stop()
    assert len(asked) <= 2  # The second has the objects that the first snapshot had no time to describe.


@pytest.mark.parametrize("off", [True, False])
def test_no_process_without_need(log, monkeypatch, off):
    """Bodies may be off, or no camera may see sizes."""
    monkeypatch.setattr(Worker, "ask", lambda self, request: pytest.fail("a process was asked"))
    blind = tuple(replace(c, camera=replace(c.camera, sees_size=False)) for c in log.cameras)
    session = session_of(log, "bodies.use=false") if off else session_of(replace(log, cameras=blind))
    assert len(session.snapshot().map) >= 5
    session.stop()


def test_one_process_answers_all_requests_until_one_fails(log, monkeypatch, own_processes):
    asked = []
    with monkeypatch.context() as patch:
        patch.setattr(Worker, "ask", lambda self, request: asked.append(request))
        session = session_of(log)
        wait_for(lambda: session.snapshot().map and asked)
        session.abort()
    worker, expected, processes = Worker(), asked[0].solve(), []
    assert any(expected)
    for request in (asked[0], asked[0], BodyRequest(None, (), None), asked[0]):
        worker.ask(request)
        processes.append(worker._process.pid)
        found = worker.result()
        if request is asked[0]:
            for body, told in zip(found, expected, strict=True):
                assert (body is None) == (told is None)
                if body is not None:
                    np.testing.assert_allclose(body.covariance, told.covariance, rtol=1e-6, atol=1e-12)
        else:
            assert found is None
    worker.close()
    assert processes[0] == processes[1] == processes[2] != processes[3]


@pytest.fixture(scope="module")
def laps():
    """Two laps between large objects, so that the robot sees them again after they have bodies."""
    return drive(2, frames=400, laps=2)


@pytest.fixture(scope="module")
def turned(laps):
    """A session that has mapped these laps."""
    session = session_of(laps)
    yield session
    session.abort()


def path_error(session, log):
    """The error, m, of the path of a running session, in its own frame, which begins at the truth."""
    path = session.snapshot().path
    true = log.truth.trajectory.poses[np.searchsorted(log.truth.trajectory.stamps, path.stamps - 1e-6)]
    return float(np.sqrt(np.mean(np.sum((path.poses[:, :2, 3] - true[:, :2, 3]) ** 2, axis=1))))


def object_error(session, log):
    """The errors, m, of the centres of the objects, after an alignment."""
    snapshot = session.snapshot()
    return evaluate(snapshot.map, log.truth, snapshot.path, align="se2", radius=1.0).to_dict()["position_rmse"]


def test_bearings_to_the_centres_of_bodies_bend_neither_map_nor_path(laps, turned, monkeypatch):
    m = turned._mapper.state
    assert (m.landmarks.shape > 0).sum() >= 4
    assert m.counters.accepted()["turns to the centres of bodies"] >= 3
    monkeypatch.setattr("objslam.live.bodies.centring._FIRST", 0)
    monkeypatch.setattr(BodyEstimator, "update", lambda self, m, covariances: None)
    points = session_of(laps)
    assert not (points._mapper.state.landmarks.shape > 0).any()
    assert path_error(turned, laps) < 0.7 * path_error(points, laps)
    assert object_error(turned, laps) < 0.7 * object_error(points, laps)
    points.abort()


def test_a_resumed_session_turns_the_same_bearings(laps, tmp_path):
    settings = load_settings(None, ALONE)
    pushes = list(events(laps))
    whole = feed(Session(settings, tmp_path / "whole", patient=True).start(), laps, 0, 440)
    killed = feed(Session(settings, tmp_path / "killed", patient=True).start(), laps, 0, 360)
    state = killed._mapper.state
    assert (state.landmarks.shape > 0).any()
    killed.abort()
    again = Session(settings, tmp_path / "killed", resume=True, patient=True).start()
    for name in ("shape", "half", "yaw", "position"):
        np.testing.assert_allclose(getattr(again._mapper.state.landmarks, name), getattr(state.landmarks, name), atol=1e-9)
    feed(again, laps, 360, pushes=pushes[360:440])
    one, other = again._mapper.state, whole._mapper.state
    assert one.counters.accepted() == other.counters.accepted()
    np.testing.assert_allclose(one.rays.to_centre, other.rays.to_centre, atol=1e-6)
    np.testing.assert_allclose(one.landmarks.position, other.landmarks.position, atol=1e-6)
    again.abort()
    whole.abort()


def test_a_map_that_turns_takes_its_bodies_along(turned):
    """After a move of the whole map, the same bearings point to the same centres."""
    turned.abort()
    m = turned._mapper.state
    at = np.flatnonzero(m.rays.used & (m.rays.owner >= 0))
    m.graph.refresh()
    m.read_positions()
    before, noise = m.to_centres(at)
    assert (before != 0).any()
    m.graph.drop_absolute()
    m.move(lift_se2(np.array([1.0, -2.0, 0.8])))
    after, same = m.to_centres(at)
    np.testing.assert_allclose(after, before, atol=1e-9)
    np.testing.assert_allclose(same, noise, atol=1e-9)
