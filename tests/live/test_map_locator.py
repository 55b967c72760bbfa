"""A session is found in the map of another day while it drives, goes over into its frame, and ends there."""

from dataclasses import replace

import numpy as np
import pytest
from driving import feed
from quick import HELD
from waiting import LIMIT

from objslam.config import Odometry, load_settings
from objslam.core.diagnostics import Ledger
from objslam.core.geometry import interpolate, inverse, lift_se2
from objslam.core.trajectory import Trajectory
from objslam.live.adapters.replay import events
from objslam.live.session.session import Session
from objslam.mapping.localization import PriorMap, moved_log
from objslam.mapping.pipeline import run
from objslam.simulation import PoseNoise, preset, simulate

UNKNOWN = lift_se2(np.array([3.0, -7.0, 2.0]))
ALL = ("mode=joint", "rays.pixel_sigma=2", "output.recording=false")
SETTINGS = load_settings(None, (*ALL, *HELD))
"""For the frame of a session, its ids and its journal."""


@pytest.fixture(scope="module")
def first():
    return simulate(preset("demo", frames=200, classes=6, false=0.0), 2)


@pytest.fixture(scope="module")
def known(first):
    settings = load_settings(None, ("mode=fixed", "output.recording=false"))
    return PriorMap("yesterday", run(first, settings, Ledger()).map)


def another_day(first, localization=None):
    """Another drive through the same room, whose poses are in a frame that nobody knows."""
    objects = tuple((o.label, tuple(o.position)) for o in first.truth.objects)
    changes = {
        "objects": 0,
        "placed": objects,
        "path": (3, 2),
        "frames": 320,
        "frame_rate": 8.0,
        "false": 0.0,
        "odometry": Odometry(),
    }
    return moved_log(simulate(preset("demo", **changes, localization=localization), 102), UNKNOWN)


def drive(log, known, settings=SETTINGS):
    return feed(Session(settings, patient=True, known=known).start(), log)


def errors(found, log):
    """How far each resolved object is from the nearest true one of its label, m, and the squared Mahalanobis distance."""
    off, squared = [], []
    for o in found.resolved():
        miss = min((o.position - t.position for t in log.truth.objects if t.label == o.label), key=np.linalg.norm)
        off.append(np.linalg.norm(miss))
        squared.append(miss @ np.linalg.solve(o.covariance, miss))
    return np.array(off), np.array(squared)


def path_error(path, log):
    true, _ = interpolate(log.truth.trajectory.stamps, log.truth.trajectory.poses, path.stamps, 1.0)
    return float(np.sqrt(((path.poses - true)[:, :3, 3] ** 2).sum(axis=1).mean()))


@pytest.mark.parametrize("localization", [None, PoseNoise(xy=0.02, yaw=0.01)])
def test_a_session_goes_over_into_the_map(first, known, localization):
    """With odometry alone, and with a localisation in a frame of its own."""
    log = another_day(first, localization)
    begin = log.truth.trajectory.poses[0]
    settings = load_settings(None, (*ALL, "checks.use=false", "bodies.use=false"))
    session, seen, frames = Session(settings, patient=True, known=known).start(), [], 0
    session.push_camera(log.cameras[0].camera)
    for _, frame, one in events(log):
        one(session)
        if frame:
            assert session.wait(LIMIT), session.failure
            frames += 1
            if frames % 8 == 0:
                seen.append(session.snapshot())
    places = [snapshot.in_map for snapshot in seen if snapshot.in_map is not None]
    over = next(i for i, snapshot in enumerate(seen) if snapshot.in_map is not None and snapshot.in_map.objects)
    assert all(snapshot.in_map.objects for snapshot in seen[over:])  # It stays there.
    early = [place for place in places if not place.objects]
    assert early or localization is not None  # With a localisation, the first search already finds the map.
    assert all(place.line.startswith("not localised in yesterday yet: too little evidence") for place in early)
    assert len(seen[over].map.resolved()) <= 8
    assert seen[-1].counters["moves into the frame of the prior map"] == 1
    assert path_error(seen[over - 1].path, log) > 1.0  # Its own frame is far off.
    for snapshot in seen[over:]:
        assert path_error(snapshot.path, log) < 0.15
        assert (errors(snapshot.map, log)[1] < 25).all()  # An object may be new, and its sigma large.
    off, squared = errors(seen[-1].map, log)
    assert len(off) >= 9
    assert np.sqrt((off**2).mean()) < 0.06
    assert (squared < 16.27).all()
    ids = {o.id: o for o in known.objects}
    for o in seen[-1].map.resolved():
        assert ids[o.id].label == o.label
        assert np.linalg.norm(ids[o.id].position - o.position) < 0.15
    # A corrected clock may put the last frame behind the end of the truth.
    stamp, odom = min(seen[-1].stamp, log.truth.trajectory.stamps[-1]), log.odometry
    at = interpolate(odom.stamps, odom.poses, np.array([stamp]), 1.0)[0][0]
    true = interpolate(log.truth.trajectory.stamps, log.truth.trajectory.poses, np.array([stamp]), 1.0)[0][0]
    assert np.linalg.norm((seen[-1].map_T_odom @ at - true)[:3, 3]) < 0.15
    result = session.stop()
    assert result.summary["localisation"]["localised"]
    assert {o.id for o in result.map.resolved()} >= {o.id for o in seen[-1].map.resolved()}
    assert path_error(Trajectory(result.keyframes.stamps, result.map_T_base), log) < 0.06
    np.testing.assert_allclose(begin, log.truth.trajectory.poses[0])


def test_a_killed_session_is_found_again_in_the_same_place(first, known, tmp_path):
    log = another_day(first)
    end = 3 * len(list(events(log))) // 4
    session = feed(Session(SETTINGS, patient=True, known=known).start(), log, end=end)
    whole = session.snapshot()
    session.abort()
    assert whole.in_map.objects
    for at, found in ((end // 6, False), (5 * end // 6, True)):
        file = tmp_path / f"{at}.objslam"
        killed = feed(Session(SETTINGS, file, patient=True, known=known).start(), log, end=at)
        place = killed.snapshot().in_map
        assert (place is not None and place.objects > 0) == found
        killed.abort()
        again = feed(Session(SETTINGS, file, resume=True, patient=True, known=known).start(), log, begin=at, end=end)
        resumed = again.snapshot()
        again.abort()
        assert resumed.in_map == whole.in_map
        np.testing.assert_allclose(resumed.map.positions, whole.map.positions, atol=1e-9)
        np.testing.assert_allclose(resumed.path.poses, whole.path.poses, atol=1e-9)


def test_another_place_leaves_the_session_in_its_own_frame(first):
    settings = load_settings(None, ("mode=fixed", *HELD))
    other = PriorMap("elsewhere", run(simulate(preset("demo", frames=200, classes=6, false=0.0), 5), settings, Ledger()).map)
    log = another_day(first)
    held = SETTINGS
    session, alone = drive(log, other, held), drive(log, None, held)
    snapshot, without = session.snapshot(), alone.snapshot()
    assert snapshot.in_map.objects == 0
    assert snapshot.in_map.line.startswith("not localised in elsewhere yet")
    np.testing.assert_allclose(snapshot.map.positions, without.map.positions, atol=1e-9)
    assert without.in_map is None
    result = session.stop()
    assert not result.summary["localisation"]["localised"]
    np.testing.assert_allclose(result.map.positions, alone.stop().map.positions)


def test_objects_that_the_map_lacks_get_ids_after_its_own(first, known):
    fewer = PriorMap("fewer", replace(known.objects, objects=known.objects.objects[:-3]))
    session = drive(another_day(first), fewer)
    shown = session.snapshot()
    assert shown.in_map.objects >= 6
    ids, end = {o.id for o in shown.map.resolved()}, {o.id: o for o in session.stop().map}
    assert {j for j in ids if j < fewer.first_free_id} <= {o.id for o in fewer.objects}
    assert any(j >= fewer.first_free_id for j in ids)
    for o in shown.map.resolved():  # Each keeps its id to the end.
        assert end[o.id].label == o.label
        assert np.linalg.norm(end[o.id].position - o.position) < 0.2


@pytest.mark.parametrize("settings", [SETTINGS, load_settings(None, (*ALL, "calibration.use=false"))])
def test_the_frame_follows_a_late_localisation(first, known, settings):
    """The session was found by odometry alone. Then a localisation moves its own frame, and its place in the map stays.

    Without bodies, and with bearings to their centres.
    """
    log = another_day(first, PoseNoise(xy=0.02, yaw=0.01))
    half = log.localization.stamps > log.localization.stamps.mean()
    turned = lift_se2(np.array([-5.0, 2.0, 1.0]))
    late = Trajectory(log.localization.stamps[half], turned @ log.localization.poses[half])
    session = drive(replace(log, localization=late), known, settings)
    snapshot = session.snapshot()
    assert snapshot.counters["moves into the frame of the prior map"] == 1
    assert snapshot.in_map.objects >= 10
    assert path_error(snapshot.path, log) < 0.15
    off, _ = errors(snapshot.map, log)
    assert off.max() < 0.2
    assert np.isfinite(inverse(snapshot.map_T_odom)).all()
