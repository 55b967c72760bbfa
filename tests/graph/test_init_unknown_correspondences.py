"""From odometry that drifts, without identities: loops are closed and the map is whole."""

import numpy as np
import pytest

from objslam.config import Settings
from objslam.core.diagnostics import Ledger
from objslam.core.geometry import lift_se2
from objslam.evaluation.evaluate import evaluate
from objslam.frontend.bearings import build_rays
from objslam.frontend.keyframes import build_keyframes
from objslam.graph import init_unknown_correspondences
from objslam.graph.init_unknown_correspondences import _planar_sigmas, initialize_unknown
from objslam.graph.loop_closure import distribute_correction
from objslam.graph.sliding_window import SlidingWindow
from objslam.mapping import pipeline
from objslam.mapping.solution import rays_moved, seen_something
from objslam.simulation import preset, simulate

pytestmark = pytest.mark.usefixtures("one_start")
STEP = {"x_per_m": 0.0, "y_per_m": 0.0, "xy_per_rad": 0.0, "yaw_per_m": 0.0, "yaw_per_rad": 0.0}
STEP |= {"floor_xy": 0.01, "floor_yaw": float(np.radians(0.3))}
LESS = {stage: {"use": False} for stage in ("checks", "bodies", "calibration")}
"""Without the stages before and after the loops."""


@pytest.mark.parametrize("seed", [0, 3])
def test_two_laps_from_odometry_alone(seed):
    log = simulate(preset("drift"), seed)
    settings = Settings.model_validate({"mode": "joint", "rays": {"pixel_sigma": 3.0}, "odometry": STEP, **LESS})
    result = pipeline.run(log, settings, Ledger())
    found = evaluate(result.map, log.truth, result.path_after, align="se2", radius=0.5)
    dead = evaluate(result.map, log.truth, log.odometry, align="se2", radius=0.5)
    objects = found.objects
    assert 2 * len(objects.matches) >= 0.95 * (2 * len(objects.matches) + len(objects.false) + len(objects.missed))
    assert np.mean(found.path.errors**2) <= np.mean(dead.path.errors**2) / 9
    assert result.summary["rounds"][-1]["rays_changed"] <= 0.02 * len(result.rays)


def test_a_large_search_for_loops_waits_for_keyframes(monkeypatch):
    """Wrong input gives new landmarks all the time. The comparisons of landmarks must not grow with them."""
    log = simulate(preset("drift", frames=120), 0)
    settings = Settings.model_validate({"mode": "joint", "odometry": STEP})
    frames = build_keyframes(log, settings, Ledger())
    keyframes, rays = seen_something(frames, build_rays(log, frames, settings, Ledger()))
    searches = []

    def large(*given):
        searches.append(1000)
        return None, 1000

    monkeypatch.setattr(init_unknown_correspondences, "find_closure", large)
    monkeypatch.setattr(init_unknown_correspondences, "_PAIRS", 40)
    initialize_unknown(keyframes, rays, (log.cameras[0].camera,), settings, lambda done, total: None)
    assert 40 * len(keyframes) - 1000 <= sum(searches) <= 40 * len(keyframes) + 1000


def test_an_exploration_goes_on_without_a_landmark(monkeypatch):
    """A solve may move all landmarks to a camera, so that none is left. The next steps make new ones."""
    log = simulate(preset("drift", frames=120), 0)
    settings = Settings.model_validate({"mode": "joint", "odometry": STEP})
    frames = build_keyframes(log, settings, Ledger())
    keyframes, rays = seen_something(frames, build_rays(log, frames, settings, Ledger()))
    solve, lost = SlidingWindow.solve, []

    def losing(window, *given):
        solve(window, *given)
        if len(window.positions) and not lost:
            lost.append(len(window.positions))
            window.positions[:] = np.nan

    monkeypatch.setattr(SlidingWindow, "solve", losing)
    start = initialize_unknown(keyframes, rays, (log.cameras[0].camera,), settings, lambda done, total: None)
    assert lost
    assert start.association.count > 5


def test_an_exploration_solves_the_whole_graph_only_at_doublings_and_loops(monkeypatch):
    """With a whole solve in each step, the time would grow with the square of the drive."""
    log = simulate(preset("drift"), 0)
    settings = Settings.model_validate({"mode": "joint", "odometry": STEP})
    frames = build_keyframes(log, settings, Ledger())
    keyframes, rays = seen_something(frames, build_rays(log, frames, settings, Ledger()))
    solve, close, whole, loops = SlidingWindow.solve, init_unknown_correspondences._Exploration._close, [], []

    def counted(window, *given):
        optimum = solve(window, *given)
        whole.append(window.solved == window.end)
        return optimum

    monkeypatch.setattr(SlidingWindow, "solve", counted)
    monkeypatch.setattr(
        init_unknown_correspondences._Exploration, "_close", lambda *of: loops.append(close(*of)) or loops[-1]
    )
    initialize_unknown(keyframes, rays, (log.cameras[0].camera,), settings, lambda done, total: None)
    assert len(whole) >= len(keyframes) / settings.joint.explore_step - 1
    assert sum(whole) <= np.log2(len(keyframes)) + 2 * len(loops) + 1  # The step after a loop is whole too.


def test_a_bent_path_begins_where_it_was_and_ends_where_it_should():
    way = lift_se2(np.column_stack([np.linspace(0, 5, 20), np.zeros(20), np.linspace(0, 1, 20)]))
    correction = lift_se2(np.array([0.3, -0.5, 0.2]))
    drift = np.linspace(0, 1, 20) ** 2
    bent = distribute_correction(way, correction, 5, 15, drift)
    np.testing.assert_array_equal(bent[:5], way[:5])
    np.testing.assert_allclose(bent[5], way[5], atol=1e-12)
    np.testing.assert_allclose(bent[15:], correction @ way[15:], atol=1e-12)
    # no step on the way takes more than its share of the whole
    steps = np.linalg.norm(np.diff((bent - way)[5:16, :3, 3], axis=0), axis=1)
    whole = np.linalg.norm((bent - way)[15, :3, 3])
    share = np.diff(drift[5:16]) / (drift[15] - drift[5])
    assert (steps <= 3 * share * max(whole, 1.0)).all()


def test_rays_moved_counts_rays_and_not_numbers():
    rng = np.random.default_rng(0)
    before = rng.integers(-1, 6, 200)
    number = np.append(rng.permutation(6), -1)
    assert rays_moved(before, number[before]) == 0
    after = before.copy()
    moved = rng.permutation(200)[:17]
    after[moved] = np.where(before[moved] < 0, 0, -1)
    assert rays_moved(before, number[after]) == 17
    assert rays_moved(np.full(5, -1), np.zeros(5, dtype=np.int64)) == 5


def test_the_drift_of_any_camera_is_told_in_the_map():
    """The same robot's drift, as a camera that looks ahead and one that looks left have it."""
    ahead = np.array([[0.0, 0.0, 1.0, 0.0], [-1.0, 0.0, 0.0, 0.0], [0.0, -1.0, 0.0, 0.3], [0.0, 0.0, 0.0, 1.0]])
    left = lift_se2(np.array([0.0, 0.0, np.pi / 2])) @ ahead
    of_map = np.diag([0.0, 0.0, 0.05, 0.3, 0.1, 0.0]) ** 2
    for camera in (ahead, left):
        turn = np.kron(np.eye(2), camera[:3, :3])
        np.testing.assert_allclose(_planar_sigmas(turn.T @ of_map @ turn, camera), [0.3, 0.1, 0.05], atol=1e-12)
