"""The trace of the estimation: what it holds is what the solver did."""

from __future__ import annotations

import numpy as np
import pytest

from objslam.config import Settings, load_settings
from objslam.core.diagnostics import Ledger
from objslam.core.result import RunResult
from objslam.mapping import pipeline
from objslam.simulation import preset, simulate

KNOWN_NOISE = tuple(f"noise.{kind}=false" for kind in ("rays", "ranges", "odometry"))  # costs have its unit
LESS = ("checks.use=false", "bodies.use=false")  # No trace comes from these.


def run(*overrides: str, classes: int = 6) -> RunResult:
    log = simulate(preset("demo", objects=6, classes=classes, frames=150), 0)
    return pipeline.run(log, load_settings(None, (*KNOWN_NOISE, *LESS, *overrides)), Ledger())


def check_solves(result: RunResult) -> None:
    for r in result.trace:
        costs = np.array([i.cost for i in r.iterations if i.stage == "solve"])
        assert len(costs)
        assert np.isfinite(costs).all()
        assert costs[-1] <= costs[0]
        np.testing.assert_allclose(r.iterations[-1].positions, r.positions, rtol=1e-5, atol=1e-5)
        np.testing.assert_allclose(r.iterations[-1].path, r.map_T_base[:, :3, 3], rtol=1e-5, atol=1e-5)
    last = result.trace[-1]
    assert last.iterations[-1].cost == pytest.approx(result.summary["cost_after"])
    np.testing.assert_array_equal(last.map_T_base, result.map_T_base)
    np.testing.assert_array_equal(last.association.object, result.association.object)


def test_fixed_poses_are_one_round() -> None:
    result = run("calibration.use=false")
    assert [r.why for r in result.trace] == ["fixed"]
    check_solves(result)


def test_each_calibration_at_fixed_poses_is_a_round() -> None:
    result = run()
    assert [r.why for r in result.trace] == ["fixed"] * (len(result.summary["rounds"]) + 1)
    check_solves(result)


def test_the_graph_is_seen_growing_along_the_odometry() -> None:
    result = run("mode=joint", "poses.use=odometry", "joint.grow_step=20", "association.method=by_label")
    assert [r.why for r in result.trace] == ["labels"]
    check_solves(result)
    grown = [i for i in result.trace[0].iterations if i.stage == "grow"]
    assert len(grown) > 1
    assert (np.diff([len(i.path) for i in grown]) > 0).all()
    assert len(grown[-1].path) == len(result.keyframes)
    assert sum(i.stage == "solve" for i in result.trace[0].iterations) == result.summary["iterations"]


def test_each_association_and_merge_is_a_round() -> None:
    result = run("mode=joint", classes=2)
    check_solves(result)
    assert result.trace[0].why == "association"
    # the last association changes nothing, so that nothing is solved again
    counts = [r["objects"] for r in result.summary["rounds"] if r["rays_changed"]]
    assert [r.association.count for r in result.trace] == counts


def test_no_recording_no_trace_and_the_same_map() -> None:
    with_trace = run("mode=joint")
    without = run("mode=joint", "output.recording=false")
    assert without.trace == ()
    np.testing.assert_array_equal(with_trace.map_T_base, without.map_T_base)
    assert Settings().output.recording
