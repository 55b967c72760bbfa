"""Uneven ground below planar poses: its size and its memory against what was drawn, and the maps with it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from log_parts import without_names
from uneven_drives import shelf_drive, uneven_drive

from objslam.config import Settings, load_settings
from objslam.core.diagnostics import Ledger
from objslam.core.geometry import lift_se2
from objslam.core.ground.flattening import flattened_lines, flattened_points, raised_covariances, raised_points
from objslam.core.ground.rise import rise_of
from objslam.core.result import RunResult
from objslam.core.types import Log
from objslam.errors import SolveError
from objslam.evaluation.evaluate import evaluate
from objslam.mapping import pipeline
from objslam.mapping.checks.agreement import agreement, bounded_part
from objslam.mapping.ground.common_tilt import _PLACE, _Poses
from objslam.mapping.ground.uneven_ground import uneven_ground, with_uneven_ground

QUIET = ("output.recording=false", "output.picture=false")
ALONE = ("checks.use=false", "bodies.use=false")
"""Without what does not correct a tilt."""


def mapped(log: Log, *told: str) -> tuple[RunResult, Ledger]:
    ledger = Ledger()
    return pipeline.run(log, load_settings(None, (*told, *QUIET)), ledger), ledger


def heights_off(result: RunResult, log: Log) -> tuple[np.ndarray, np.ndarray]:
    """The errors of the heights of the resolved objects, m, and their standard deviations."""
    true = {item.label: item.position for item in log.truth.objects}
    found = [item for item in result.map.resolved() if item.covariance is not None]
    assert len(found) >= 18
    off = np.array([item.position[2] - true[item.label][2] for item in found])
    return off, np.sqrt([item.covariance[2, 2] for item in found])


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("degrees", [1.0, 2.0, 4.0])
def test_the_drawn_tilt_is_found(degrees, seed):
    found = uneven_ground(uneven_drive(np.radians(degrees), 0.0, seed), Settings(mode="fixed"))
    assert np.degrees(found.tilt) == pytest.approx(degrees, rel=0.25)
    assert found.height < 0.1
    assert found.seconds <= 0.5


@pytest.mark.parametrize("seed", range(3))
def test_the_memory_of_the_tilt_is_found(seed):
    found = uneven_ground(uneven_drive(0.03, 2.0, seed), Settings(mode="fixed"))
    assert 1.0 <= found.seconds <= 4.0
    assert found.tilt == pytest.approx(0.03, rel=0.6)


@pytest.mark.parametrize("mount", [0.0, 0.05])
@pytest.mark.parametrize("seed", range(3))
def test_flat_ground_is_not_found_uneven_whatever_the_mount(mount, seed):
    settings, ledger = Settings(mode="fixed"), Ledger()
    log = uneven_drive(0.0, seed=seed, mount=mount)
    assert with_uneven_ground(log, settings, ledger, lambda stage, done, total: None) == settings
    assert not ledger.warnings


@pytest.mark.parametrize("seed", range(3))
def test_tags_above_each_other_are_no_tilt(seed):
    """If tags on two boards are taken for one thing, the difference of their heights looks like a tilt."""
    assert uneven_ground(shelf_drive(seed), Settings(mode="fixed")) is None


@pytest.mark.parametrize("degrees", [0.5, 2.0, 6.0])
def test_the_tilt_of_a_drive_past_equal_things_is_found(degrees):
    """Labels do not tell which post a box shows. The estimate begins below some tilts and above others."""
    found = uneven_ground(without_names(uneven_drive(np.radians(degrees), 0.0, 1, posts=14)), Settings(mode="fixed"))
    assert np.degrees(found.tilt) == pytest.approx(degrees, rel=0.3)


def from_odometry(tilt: float) -> Log:
    return replace(without_names(uneven_drive(tilt, 1.5, 1, posts=14)), localization=None)


@pytest.mark.parametrize("tilt", [0.0, 0.01])
def test_small_tilts_are_left_to_a_joint_map_from_odometry(tilt):
    assert uneven_ground(from_odometry(tilt), Settings(mode="joint")) is None


def test_rough_ground_loses_no_object_of_a_joint_map_from_odometry():
    """On ground that counts as flat, 3 of the 14 posts are missing, and 15 objects are false."""
    log = from_odometry(0.035)
    result, ledger = mapped(log, "mode=joint", *ALONE)
    assert any("the ground is uneven" in line for line in ledger.warnings)
    score = evaluate(result.map, log.truth, align="se2", radius=1.0).to_dict()
    assert (score["matched"], score["false"]) == (14, 0)
    assert score["inside_95_3d"] >= 0.9


def test_the_user_may_know_better():
    log, ledger = uneven_drive(0.03), Ledger()
    for told in ("noise.ground=false", "planar.tilt=0.01"):
        settings = load_settings(None, ("mode=fixed", told))
        assert with_uneven_ground(log, settings, ledger, lambda stage, done, total: None) == settings


@pytest.mark.parametrize("seconds", [0.0, 4.0])
def test_a_map_at_given_poses_is_honest_on_uneven_ground(seconds):
    log = uneven_drive(0.035, seconds, 1)
    result, ledger = mapped(log, "mode=fixed")
    off, sigma = heights_off(result, log)
    assert (np.abs(off) < 1.96 * sigma).mean() >= 0.85
    assert result.summary["assessment"]["level"] != "bad"
    assert any("the ground is uneven: the robot rolls and pitches by about" in line for line in ledger.warnings)


def test_boxes_agree_better_if_the_tilt_of_rough_ground_is_allowed_for():
    """The checks call an input wrong whose boxes agree too badly."""
    log, settings = uneven_drive(0.07, 1.0, 1), Settings(mode="fixed")
    allowed = with_uneven_ground(log, settings, Ledger(), lambda stage, done, total: None)
    part = bounded_part(log, settings)
    before, after = (agreement(part, part.log, told) for told in (settings, allowed))
    assert after.score > before.score + 0.2


def test_a_joint_solve_corrects_the_tilt():
    log = uneven_drive(0.035, 4.0, 1)
    result, _ = mapped(log, "mode=joint", "noise.localization=false", *ALONE)
    off, sigma = heights_off(result, log)
    fixed, _ = heights_off(mapped(log, "mode=fixed", *ALONE)[0], log)
    assert np.sqrt((off**2).mean()) < 0.7 * np.sqrt((fixed**2).mean())
    assert (np.abs(off) < 1.96 * sigma).mean() >= 0.85
    at = np.searchsorted(log.truth.trajectory.stamps, result.keyframes.stamps)
    left = result.map_T_base[:, 2, :2] - log.truth.trajectory.poses[at, 2, :2]
    assert np.sqrt((left**2).mean()) < 0.6 * 0.035


def test_heights_of_a_joint_map_above_hilly_ground_are_honest():
    """The ground between the robot and a post rises or falls in the same way at each visit, so visits average nothing out.
    A solve that also takes the height of the robot for unknown bends the map by up to a metre."""
    off, sigma = [], []
    for seed in (0, 2):
        log = uneven_drive(0.003, 0.5, seed, hills=0.2)
        found = heights_off(mapped(log, "mode=joint")[0], log)
        off += found[0].tolist()
        sigma += found[1].tolist()
    ratio = np.abs(off) / sigma
    assert 0.9 <= (ratio < 1.96).mean()
    assert np.median(ratio) > 0.2  # The sigmas are at most three times too large: a normal distribution has 0.67.


def test_lines_that_meet_also_meet_in_a_flattened_world():
    rng = np.random.default_rng(0)
    point, origins = np.array([2.0, 1.0, 3.0]), rng.normal(size=(5, 3))
    ways = np.linalg.norm(point - origins, axis=1)
    flat, directions, longer = flattened_lines(origins, (point - origins) / ways[:, None], 0.2)
    ends = flat + directions * (ways * longer)[:, None]
    np.testing.assert_allclose(ends, np.broadcast_to(flattened_points(point, 0.2), ends.shape))
    np.testing.assert_allclose(raised_points(ends, 0.2), np.broadcast_to(point, ends.shape))
    root = rng.normal(size=(3, 3))
    several = rng.normal(size=(200_000, 3)) @ root.T
    told = raised_covariances(root @ root.T, 0.2)
    np.testing.assert_allclose(np.cov(raised_points(several, 0.2).T), told, atol=0.02 * np.abs(told).max())


def test_ground_that_tilts_rises_over_its_way_but_not_over_more_than_the_site():
    stamps = np.arange(101.0)
    line = lift_se2(np.column_stack([stamps, 0 * stamps, 0 * stamps]))  # 1 m/s, 100 m
    assert rise_of(stamps, line, np.array([0.01]), np.array([5.0])) == pytest.approx(0.05)
    assert rise_of(stamps, line, np.array([0.01]), np.array([1e4])) == pytest.approx(0.01 * stamps.std(), rel=1e-6)
    assert rise_of(stamps, line, np.array([0.03, 0.04]), np.array([1.0, 1.0])) == pytest.approx(0.05)


@pytest.mark.parametrize("lasts", [False, True])
@pytest.mark.parametrize("kinds", [3, 5])
def test_the_likelihood_is_that_of_the_normal_distribution(kinds, lasts):
    """The cost, the effects and the errors of the poses, from the covariance of all rays."""
    rng, poses, count = np.random.default_rng(0), 8, 30
    pose = np.sort(np.append(np.arange(poses), rng.integers(0, poses, count - poses)))
    miss, by_pose, effects = rng.standard_normal(count), rng.standard_normal((count, kinds)), rng.standard_normal((count, 4))
    alike = np.exp(-np.abs(np.arange(poses)[:, None] - np.arange(poses)) / 3) if lasts else np.eye(poses)
    factor, tilt, height = sizes = np.array([1.3, 0.5, 0.7])
    cost, found, errors = _Poses.of(miss, by_pose, effects, pose, 20.0).solve(np.log(sizes), alike if lasts else None)
    sigma = np.array([tilt, tilt, height, _PLACE, _PLACE])[:kinds]
    of_poses = np.zeros((count, poses, kinds))
    of_poses[np.arange(count), pose] = by_pose * sigma
    shared = np.einsum("rki,kl->rli", of_poses, alike)
    covariance = factor**2 * np.eye(count) + np.einsum("rki,ski->rs", shared, of_poses) + effects @ effects.T
    pull = np.linalg.solve(covariance, miss)
    fit = miss @ pull + np.linalg.slogdet(covariance)[1] + 20 * (2 * np.log(factor) + factor**-2)
    assert cost == pytest.approx(fit, rel=1e-7)
    np.testing.assert_allclose(found, effects.T @ pull, rtol=1e-6)
    np.testing.assert_allclose(errors, sigma * np.einsum("rki,r->ki", shared, pull), rtol=1e-6, atol=1e-9)


@pytest.mark.parametrize("lasts", [False, True])
def test_rays_that_are_not_finite_are_an_error(lasts):
    rng, poses = np.random.default_rng(0), 8
    pose = np.repeat(np.arange(poses), 4)
    miss, by_pose, effects = rng.standard_normal(32), rng.standard_normal((32, 3)), rng.standard_normal((32, 4))
    by_pose[5, 0] = np.nan
    with pytest.raises(SolveError, match="not finite"):
        _Poses.of(miss, by_pose, effects, pose, 20.0).solve(np.zeros(3), np.eye(poses) if lasts else None)
