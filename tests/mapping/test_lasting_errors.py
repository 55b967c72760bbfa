"""Errors of poses that last for some seconds: their size against what was drawn, and the sigmas of a map with them."""

from __future__ import annotations

from dataclasses import replace
from itertools import product

import numpy as np
import pytest
from lasting_localization import with_lasting
from quick import HELD

from objslam.config import Odometry, load_settings
from objslam.core.diagnostics import Ledger
from objslam.core.geometry import make_pose
from objslam.core.rotation import rotation_from_vector
from objslam.core.types import Log
from objslam.errors import SolveError
from objslam.mapping import pipeline
from objslam.mapping.fixed.lasting_noise import _FACTORS, _KINDS, _LOOSE, TIMES, Cells, _misfits, lasting_variances
from objslam.mapping.stages import described
from objslam.simulation import PoseNoise, preset, simulate


def squares(log: Log) -> list[float]:
    settings = load_settings(
        None, ("mode=fixed", *HELD, "noise.localization=true", "rays.box_sigma=0", "output.recording=false")
    )
    result = pipeline.run(log, settings, Ledger())
    place = {item.label: item.position for item in log.truth.objects}
    off = [(item.position - place[item.label], item.covariance) for item in result.map.resolved()]
    return [float(miss @ np.linalg.solve(covariance, miss)) for miss, covariance in off]


def test_errors_of_poses_that_last_are_in_the_covariances(monkeypatch):
    logs = []
    for seed in range(3):
        noise = {"localization": PoseNoise(xy=0.005, yaw=0.001), "pixel_sigma": 1.0}
        log = simulate(preset("demo", odometry=None, objects=12, classes=12, frames=300, false=0.0, **noise), seed)
        logs.append(with_lasting(log, 2.5, 16.0, seed))
    found = np.concatenate([squares(log) for log in logs])
    monkeypatch.setattr(described, "with_lasting_errors", lambda solution, *_: (solution, None))
    without = np.concatenate([squares(log) for log in logs])
    # An honest median is 2.4. A drive of one minute has few independent errors of 16 s, and its objects share them.
    assert np.median(without) > 30
    assert np.median(found) < 6


def test_the_status_of_an_object_knows_its_lasting_errors(monkeypatch):
    """`seen_sigma` decides whether an object is resolved."""
    made, wider = [], described.with_lasting_errors
    monkeypatch.setattr(
        described, "with_lasting_errors", lambda *given: made.append((given[0], wider(*given))) or made[0][1]
    )
    log = simulate(preset("demo", odometry=None, objects=6, classes=6, frames=150, false=0.0), 0)
    squares(with_lasting(log, 2.5, 16.0, 0))
    before, after = made[0][0].estimate, made[0][1][0].estimate
    there = after.solved
    assert (after.seen_sigma[there] > 1.05 * before.seen_sigma[there]).all()
    largest = np.sqrt(np.linalg.eigvalsh(after.covariance[there])[:, -1])
    np.testing.assert_allclose(after.seen_sigma[there], largest)


def drawn(times, owner, factors, time, rng):
    """Angles that are drawn from the model: all objects share the errors of the poses, and each is off by some
    centimetres."""
    count = len(times)
    order = np.lexsort((times, owner))
    times, owner = times[order], owner[order]
    heading, level = rng.uniform(-np.pi, np.pi, owner.max() + 1)[owner] + rng.normal(0, 0.3, count), rng.uniform(2, 5, count)
    axis = np.column_stack([np.cos(heading), np.sin(heading), np.zeros(count)])
    turn, move, white = np.tile([0.0, 0.0, 0.005], (count, 1)), 0.02 * axis / level[:, None], np.full(count, 0.003)
    alike = np.exp(-np.abs(times[:, None] - times) / time)
    errors = factors[0] ** 2 * turn @ turn.T + factors[1] ** 2 * move @ move.T
    off = (rng.normal(0, 0.05, (owner.max() + 1, 3))[owner] * axis).sum(axis=1) / level
    mean = rng.multivariate_normal(np.zeros(count), errors * alike) + white * rng.standard_normal(count) + off
    return Cells(owner, times, mean, white, axis / level[:, None], turn, move, np.zeros((count, 3)))


@pytest.mark.parametrize(
    ("factors", "time"), [((0.0, 0.0), 1.0), ((0.5, 0.5), 4.0), ((1.5, 1.5), 16.0), ((4.0, 4.0), 64.0), ((2.0, 0.0), 4.0)]
)
def test_the_size_of_lasting_errors_is_found(factors, time):
    rng = np.random.default_rng(1)
    cells = drawn(rng.uniform(0, 600, 600), np.repeat(np.arange(15), 40), factors, time, rng)
    found = np.sqrt(lasting_variances(cells).sum(axis=1))
    assert found[0] == pytest.approx(factors[0], rel=0.3, abs=0.15)
    assert np.hypot(*found) == pytest.approx(np.hypot(*factors), rel=0.3, abs=0.2)


@pytest.mark.parametrize("objects", [1, 2, 12])
def test_the_likelihood_is_that_of_the_normal_distribution(objects):
    """The variances, from the covariance of all cells for each hypothesis."""
    rng = np.random.default_rng(2)
    cells = drawn(rng.uniform(0, 60, objects**2), np.repeat(np.arange(objects), objects), (1.0, 0.5), 4.0, rng)
    same = cells.owner[:, None] == cells.owner
    known = np.diag(cells.white**2) + _LOOSE**2 * same * (cells.shift @ cells.shift.T)
    posterior = np.zeros((len(_KINDS), len(TIMES), len(_FACTORS)))
    for (m, (turned, moved)), (t, time), (f, factor) in product(*map(enumerate, (_KINDS, TIMES, _FACTORS))):
        errors = turned * cells.turn @ cells.turn.T + moved * cells.move @ cells.move.T
        covariance = known + factor**2 * errors * np.exp(-np.abs(cells.times[:, None] - cells.times) / time)
        fit = cells.mean @ np.linalg.solve(covariance, cells.mean) + np.linalg.slogdet(covariance)[1]
        posterior[m, t, f] = -0.5 * (factor**2 + fit)
    weight = np.exp(posterior - posterior.max()) * np.gradient(_FACTORS)
    expected = np.einsum("mtf,f,mk->kt", weight / weight.sum(), _FACTORS**2, _KINDS)
    np.testing.assert_allclose(lasting_variances(cells), expected, rtol=1e-8)


@pytest.mark.parametrize("column", ["mean", "white", "turn"])
def test_misses_that_are_not_finite_are_an_error(column):
    rng = np.random.default_rng(0)
    cells = drawn(rng.uniform(0, 60, 40), np.repeat(np.arange(4), 10), (1.0, 1.0), 4.0, rng)
    values = getattr(cells, column).copy()
    values[3] = np.nan
    with pytest.raises(SolveError, match="not finite"):
        lasting_variances(replace(cells, **{column: values}))


def test_a_negative_eigenvalue_by_rounding_counts_as_0():
    rotation = np.linalg.qr(np.random.default_rng(0).standard_normal((3, 3)))[0]
    size, mean, factors = np.array([-0.3, 0.0, 2.0]), np.array([1.0, -2.0, 0.5]), np.array([0.5, 5.0])
    found = _misfits(np.asfortranarray(rotation * size @ rotation.T), mean, factors)
    for factor, misfit in zip(factors, found, strict=True):
        covariance = np.eye(3) + factor * rotation * np.maximum(size, 0.0) @ rotation.T
        expected = mean @ np.linalg.solve(covariance, mean) + np.linalg.slogdet(covariance)[1]
        assert misfit == pytest.approx(expected)


def test_objects_that_were_seen_once_show_the_errors_that_they_share():
    """Each object was seen for 6 s, so its place absorbs much of an error that lasts for 4 s. Together they show it."""
    found = []
    for seed in range(6):
        rng = np.random.default_rng(seed)
        begin = np.repeat(np.linspace(0, 150, 60), 6)
        cells = drawn(begin + np.tile(np.arange(6.0), 60), np.repeat(np.arange(60), 6), (2.0, 0.0), 4.0, rng)
        found.append(np.sqrt(lasting_variances(cells)[0].sum()))
    assert np.mean(found) == pytest.approx(2.0, rel=0.15)
    assert min(found) > 1.4


def test_lasting_errors_are_the_same_with_any_axis_up_and_reach_heights_in_3d(monkeypatch):
    """A map on its side is the same map. Poses in a plane do not err in height, and other poses do."""
    made, wider = [], described.with_lasting_errors
    monkeypatch.setattr(described, "with_lasting_errors", lambda *given: made.append(given) or wider(*given))
    log = simulate(preset("demo", odometry=None, objects=6, classes=6, frames=150, false=0.0, pixel_sigma=1.0), 0)
    log = with_lasting(log, 2.5, 16.0, 0)
    squares(log)
    pitch = 0.005 * np.sin(log.localization.stamps / 3)[:, None] * [0.0, 1.0, 0.0]
    tilted = log.localization.poses @ make_pose(rotation_from_vector(pitch), np.zeros(3))
    squares(replace(log, localization=replace(log.localization, poses=tilted)))
    (flat, settings, *_), (solid, *_) = made

    def added(solution):
        return wider(solution, settings)[0].estimate.covariance - solution.estimate.covariance

    assert np.median(added(solid)[:, 2, 2]) > 5 * np.median(added(flat)[:, 2, 2])
    turn = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])  # y points down.
    poses, estimate = make_pose(turn, np.zeros(3)) @ solid.keyframes.map_T_base, solid.estimate
    covariance = turn @ estimate.covariance @ turn.T
    estimate = replace(estimate, positions=estimate.positions @ turn.T, covariance=covariance)
    turned = replace(solid, keyframes=replace(solid.keyframes, map_T_base=poses), estimate=estimate)
    np.testing.assert_allclose(added(turned), turn @ added(solid) @ turn.T, atol=1e-9)


def test_poses_that_err_for_seconds_are_named_and_auto_solves_them_too():
    """Headings err by 2 degrees for eight seconds at a time. In fixed mode the map says so, and is off. Mode auto is joint
    mode then, and as exact. A localisation as the settings say stays as it is."""
    log = simulate(preset("demo", objects=12, classes=12, frames=200, false=0.0, pixel_sigma=1.0), 3)
    bad = with_lasting(log, 7.0, 8.0, 3)
    place = {item.label: item.position for item in log.truth.objects}

    def mapped(log: Log, mode: str):
        ledger = Ledger()
        result = pipeline.run(
            log, load_settings(None, (f"mode={mode}", "output.recording=false", "bodies.use=false")), ledger
        )
        return result, ledger, [np.linalg.norm(item.position - place[item.label]) for item in result.map.resolved()]

    fixed, once, off = mapped(bad, "fixed")
    assert [found["name"] for found in fixed.summary["wrong_input"]] == ["localisation noise"]
    assert fixed.summary["assessment"]["level"] == "check"
    less_noisy, _, _ = mapped(with_lasting(log, 2.0, 8.0, 3), "fixed")
    assert [found["name"] for found in less_noisy.summary["wrong_input"]] == ["lasting localisation errors"]
    assert "--mode joint" in " ".join(less_noisy.summary["warnings"])
    solved, ledger, less = mapped(bad, "auto")
    assert solved.summary["mode"] == "joint"
    assert "errs for seconds" in " ".join(ledger.lines())
    assert np.median(less) < 0.7 * np.median(off)
    assert ledger.dropped == once.dropped  # What both runs dropped counts once.
    assert mapped(log, "auto")[0].summary["mode"] == "fixed"


def test_auto_also_solves_poses_in_space_that_err_from_frame_to_frame():
    """Such poses, as those of a visual odometry that a filter corrects, say nothing of errors that last."""
    log = simulate(
        preset(
            "demo",
            objects=8,
            classes=8,
            frames=150,
            false=0.0,
            pixel_sigma=1.0,
            odometry=Odometry(),
            localization=PoseNoise(xy=0.06, yaw=0.02),
        ),
        0,
    )
    path, rng = log.localization, np.random.default_rng(0)
    tilts = rotation_from_vector(np.column_stack([0.003 * rng.standard_normal((len(path), 2)), np.zeros(len(path))]))
    log = replace(log, localization=replace(path, poses=path.poses @ make_pose(tilts, np.zeros((len(path), 3)))))
    place = {item.label: item.position for item in log.truth.objects}
    off = {}
    for mode in ("fixed", "auto"):
        result = pipeline.run(
            log, load_settings(None, (f"mode={mode}", "output.recording=false", "bodies.use=false")), Ledger()
        )
        off[mode] = [np.linalg.norm(item.position - place[item.label]) for item in result.map.resolved()]
    assert result.summary["mode"] == "joint"
    assert "errs by more than its settings say" in " ".join(result.summary["warnings"])
    assert len(off["auto"]) == 8
    assert np.median(off["auto"]) < 0.5 * np.median(off["fixed"])
