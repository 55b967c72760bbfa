"""Bodies in the snapshots of a running session, and the process beside the session that fits them."""

import threading
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from mapping.body_drives import drive
from waiting import wait_for

from objslam.config import load_settings
from objslam.live.adapters.replay import ReplayAdapter
from objslam.live.session.body_estimation import BodyRequest
from objslam.live.session.session import Session
from objslam.live.worker import Worker


@pytest.fixture(scope="module")
def log():
    return drive(1)


def session_of(log, *changes):
    """A session that has mapped a whole log and still runs."""
    session = Session(load_settings(None, ("calibration.use=false", *changes)), patient=True).start()
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
    monkeypatch.setattr("objslam.live.session.body_estimation._REST", 0.0)
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


def test_one_process_answers_all_requests_until_one_fails(log, monkeypatch):
    asked = []
    with monkeypatch.context() as patch:
        patch.setattr(Worker, "ask", lambda self, request: asked.append(request))
        session = session_of(log)
        wait_for(lambda: session.snapshot().map and asked)
        session.stop()
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
