"""Bodies in the whole pipeline: a robot that drives between large objects, and what becomes of its map and its path."""

import threading
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from bench_robots import robot
from mapping.body_drives import drive, scores

from objslam.config import load_settings
from objslam.core.diagnostics import Ledger
from objslam.core.geometry import lift_se2
from objslam.evaluation.evaluate import evaluate
from objslam.live.adapters.replay import ReplayAdapter
from objslam.live.session.session import Session
from objslam.mapping import pipeline
from objslam.mapping.localization import PriorMap, moved_log


@cache
def scores_of_drive(seed):
    """The result of the drive as it is, and its evaluation."""
    return scores(drive(seed))


@pytest.mark.parametrize("seed", [1, 14])
def test_large_objects_bend_neither_map_nor_path(seed):
    """In drive 14, an object would be lost by bearings to its body. The bearings to the other bodies still count."""
    log = drive(seed)
    _, points = scores(log, "bodies.use=false")
    result, bodies = scores_of_drive(seed)
    assert bodies["matched"] >= max(points["matched"], 7)
    assert bodies["ate"] < 0.7 * points["ate"]
    assert bodies["position_rmse"] < 0.7 * points["position_rmse"]
    assert bodies["iou_median"] > 0.6
    assert bodies["size_error_median"] < 0.15
    assert bodies["inside_95_3d"] >= 0.875
    for o in result.map:
        assert o.body is not None
        assert (o.body.size_sigma > 0).all()


@pytest.mark.parametrize("seed", [1, 14])
def test_wrong_names_spoil_no_body(seed):
    """Six of a hundred boxes show another thing. A shape is found from a few boxes of each side, which must not be these."""
    log, rng = drive(seed), np.random.default_rng(seed)
    _, right = scores_of_drive(seed)
    found = log.cameras[0].detections
    label = np.where(rng.random(len(found)) < 0.06, rng.integers(0, 8, len(found)), found.label)
    renamed = replace(log.cameras[0], detections=replace(found, label=label))
    _, bodies = scores(replace(log, cameras=(renamed,)))
    assert tuple(bodies[name] for name in ("matched", "false", "missed")) == (8, 0, 0)
    assert bodies["position_rmse"] < 1.2 * right["position_rmse"]
    assert bodies["ate"] < 1.2 * right["ate"]
    assert bodies["iou_median"] > 0.9 * right["iou_median"]


def test_a_box_with_a_wrong_name_is_not_turned_to_the_body_of_that_name():
    """thing_0 has nine boxes, one of which shows another thing 45 degrees aside. If it is turned too, it seems to agree."""
    log, _ = robot(7000, "vio")
    result = pipeline.run(log, load_settings(None, ("mode=joint", "output.recording=false")), Ledger())
    compared = evaluate(result.map, log.truth, align="se2", radius=0.5).to_dict()
    assert tuple(compared[name] for name in ("matched", "false", "missed")) == (8, 0, 0)
    assert compared["inside_95_3d"] >= 0.875


@pytest.mark.parametrize("seed", [1, 2])
def test_large_objects_do_not_move_the_camera_in_fixed_mode(seed):
    """The drives have no shared errors. The centres of boxes lie beside those of bodies, in the same direction each time."""
    log = drive(seed, laps=2, frames=300)
    log = replace(log, odometry=None, localization=log.truth.trajectory)
    worst = {}
    for bodies in ("true", "false"):
        settings = load_settings(None, ("mode=fixed", "output.recording=false", f"bodies.use={bodies}"))
        result = pipeline.run(log, settings, Ledger())
        found = result.calibration
        worst[bodies] = (np.abs(found.values) / found.sigma).max()
        blamed = any("the poses err" in warning for warning in result.summary["warnings"])
        assert not (blamed and bodies == "true")  # The poses are exact.
    assert worst["true"] < 0.7
    assert worst["true"] < 0.6 * worst["false"]


def test_how_rays_meet_does_not_change_how_sure_a_body_is():
    """The rays of large things miss one point by far, so the covariance of Eq. 1 is far larger than that of squares."""
    log = drive(1)
    log = replace(log, odometry=None, localization=log.truth.trajectory)
    sigmas = []
    for loss in ("l1", "cauchy"):
        settings = load_settings(None, ("mode=fixed", "output.recording=false", f"fixed.loss={loss}"))
        found = pipeline.run(log, settings, Ledger()).map.resolved()
        sigmas.append({o.label: np.sqrt(np.trace(o.covariance)) for o in found if o.ray_point is not None})
    one, other = sigmas
    both = one.keys() & other.keys()
    assert len(both) >= 4
    for label in both:
        assert one[label] == pytest.approx(other[label], rel=0.25)


def test_a_known_size_is_kept():
    log = drive(1)
    length, width, height = log.truth.objects[3].size.tolist()
    result, _ = scores(log, f"bodies.sizes={{thing 3: [{length}, {width}, {height}]}}")
    (thing,) = (o for o in result.map if o.label == "thing 3")
    np.testing.assert_allclose(thing.body.size, [length, width, height], rtol=0.1)
    assert (thing.body.size_sigma <= 0.15 * thing.body.size).all()


def test_a_drive_in_an_older_map_has_its_bodies_there():
    """The same things in another frame: centres, headings and ray points come back to those of the map."""
    log, settings = drive(1), load_settings(None, ("mode=joint", "calibration.use=false", "output.recording=false"))
    known = pipeline.run(log, settings, Ledger()).map
    away = moved_log(log, lift_se2(np.array([3.0, -2.0, 1.1])))
    session = Session(settings, patient=True, known=PriorMap("yesterday", known)).start()
    ReplayAdapter(session, away, None, session.wait).run(threading.Event())
    there = {o.id: o for o in known}
    for result, far in (
        (pipeline.run(away, settings, Ledger(), known=PriorMap("yesterday", known)), 0.02),
        (session.stop(), 1.0),
    ):
        assert result.summary["localisation"]["localised"]
        assert {o.id for o in result.map} == there.keys()
        turns = []
        for o in result.map:
            before = there[o.id]
            least = min(far, 2 * (o.sigma + before.sigma))  # The end of a session explains the boxes a little otherwise.
            assert np.linalg.norm(o.position - before.position) < least
            assert np.linalg.norm(ray_point(o) - ray_point(before)) < least
            turns.append((o.body.yaw - before.body.yaw + np.pi / 2) % np.pi - np.pi / 2)
        assert np.median(np.abs(turns)) < 0.5  # The frames differ by 1.1 rad, and the yaws are hardly known.


def ray_point(o):
    return o.position if o.ray_point is None else o.ray_point
