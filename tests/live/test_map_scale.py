"""Snapshots of a map whose metre is not known."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from driving import feed

from objslam.config import Odometry, load_settings
from objslam.core.trajectory import Trajectory
from objslam.evaluation.evaluate import evaluate
from objslam.live.session import map_scale
from objslam.live.session.map_scale import scale_covariances, scale_sigma
from objslam.live.session.session import Session
from objslam.simulation import preset, simulate

PRIORS = "live.calibrate_from=1000"  # No calibration before the end, so that the priors count.


def too_long(seed):
    """A drive without depths whose odometry says 4 % too much."""
    drive = {"frames": 150, "classes": 12, "false": 0.0, "localization": None, "odometry": Odometry()}
    log = simulate(preset("demo", **drive), seed)
    poses = log.odometry.poses.copy()
    poses[:, :3, 3] = poses[0, :3, 3] + 1.04 * (poses[:, :3, 3] - poses[0, :3, 3])
    camera = log.cameras[0]
    nothing = np.full_like(camera.detections.depths, np.nan)
    alone = replace(camera, detections=replace(camera.detections, depths=nothing), depth=None)
    return replace(log, odometry=Trajectory(log.odometry.stamps, poses), cameras=(alone,))


@pytest.mark.parametrize(("seed", "settings"), [(1, ()), (2, ()), (2, (PRIORS,))])
def test_objects_lie_inside_their_ellipsoids_though_the_odometry_is_too_long(seed, settings, monkeypatch):
    log = too_long(seed)
    session = feed(Session(load_settings(None, ("mode=joint", *settings)), patient=True).start(), log)
    inside = evaluate(session.snapshot().map, log.truth, align="se2").to_dict()["inside_95_3d"]
    monkeypatch.setattr(map_scale, "scale_sigma", lambda m: 0.0)
    surer = evaluate(session.snapshot().map, log.truth, align="se2").to_dict()["inside_95_3d"]
    session.abort()
    assert inside >= 11 / 12
    assert surer <= 9 / 12


def state(*settings, localized=False, ranged=False, calibration=None):
    """What the scale of a map depends on. The robot began at (1, 0, 0)."""
    stamp, place = np.array([2.0, 1.0]), np.tile(np.eye(4), (2, 1, 1))
    place[1, :3, 3] = 1.0, 0.0, 0.0
    return SimpleNamespace(
        keyframes=SimpleNamespace(stamp=stamp, id=np.arange(2), localized=np.array([False, localized])),
        rays=SimpleNamespace(range=np.array([np.nan, 2.0 if ranged else np.nan])),
        graph=SimpleNamespace(poses=lambda ids: place[ids]),
        given=load_settings(None, settings),
        calibration=calibration,
    )


def test_who_knows_the_metre(monkeypatch):
    monkeypatch.setattr(map_scale, "map_T_graph", lambda graph: None)
    assert scale_sigma(state()) == pytest.approx(0.03)
    assert scale_sigma(state(ranged=True)) == pytest.approx((0.03**-2 + 0.02**-2) ** -0.5)
    found = SimpleNamespace(names=("odometry.turn_scale", "odometry.scale"), sigma=np.array([0.1, 0.004]))
    assert scale_sigma(state(ranged=True, calibration=found)) == 0.004
    assert scale_sigma(state(localized=True)) == 0
    assert scale_sigma(state("calibration.use=false")) == scale_sigma(state("calibration.scale=0")) == 0
    monkeypatch.setattr(map_scale, "map_T_graph", lambda graph: np.eye(4))  # The session lies in a known map.
    assert scale_sigma(state()) == 0


def test_the_scale_moves_things_away_from_the_start(monkeypatch):
    """Monte Carlo: maps with other metres, which agree at the first keyframe."""
    monkeypatch.setattr(map_scale, "map_T_graph", lambda graph: None)
    place, start = np.array([[4.0, -2.0, 1.0], [1.0, 0.0, 0.0]]), np.array([1.0, 0.0, 0.0])
    found = scale_covariances(state(), place)
    factor = 1 + np.random.default_rng(0).normal(0, 0.03, 200_000)
    drawn = start + factor[:, None, None] * (place - start)
    np.testing.assert_allclose(found[0], np.cov(drawn[:, 0].T), rtol=0.02)
    assert not found[1].any()
