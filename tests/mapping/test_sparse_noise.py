"""The noise of a street past which a car with GPS drives: against what was drawn, and wrong mounts that look like noise."""

import re
from dataclasses import replace

import numpy as np
import pytest
from association_parts.streets import street_counts
from peers.street import simulate_street

from objslam.association.few_rays.additional_objects import FewRayEvidence
from objslam.config import Settings
from objslam.core.diagnostics import Ledger
from objslam.core.geometry import lift_se2
from objslam.errors import SolveError
from objslam.evaluation.evaluate import evaluate
from objslam.mapping import pipeline
from objslam.mapping.checks.diagnosis import Diagnosis, diagnose
from objslam.mapping.checks.finding import Finding
from objslam.mapping.checks.hypotheses.disagreement import DISAGREE
from objslam.mapping.checks.hypotheses.every import with_poses
from objslam.mapping.fixed import few_box_search
from objslam.mapping.fixed import sparse_noise as tested
from objslam.mapping.fixed.few_box_search import Searched, SparseNoise, middle, search_objects
from objslam.mapping.fixed.residual_noise import noise_of_residuals
from objslam.mapping.fixed.sparse_noise import sparse_noise, with_sparse_noise

FIXED = Settings.model_validate({"mode": "fixed", "output": {"recording": False}, "bodies": {"use": False}})


def accused() -> Diagnosis:
    return Diagnosis((Finding(DISAGREE, "the boxes disagree", basis="boxes"),))


def silent(stage: str, done: int, total: int) -> None:
    pass


@pytest.fixture(scope="module")
def searches():
    """What a search of the noise found, by the log and the settings. The search is the same in each mode."""
    return {}


@pytest.fixture
def few_tried(monkeypatch, searches):
    """Fewer noises than usual are tried, the true ones among them. A search that another test made is not made again."""
    monkeypatch.setattr(tested, "_PLACES", (1.0, 30.0))
    monkeypatch.setattr(tested, "_RAYS", (1.0,))
    monkeypatch.setattr(tested, "_TURN", 90)

    def once(log, settings, progress):
        boxes = tuple(one.detections.boxes.tobytes() for one in log.cameras)
        of_log = tested._TURN, log.localization.poses.tobytes(), boxes
        key = *of_log, settings.model_copy(update={"mode": "fixed"}).model_dump_json()
        if key not in searches:
            searches[key] = sparse_noise(log, settings, progress)
        return searches[key]

    monkeypatch.setattr(tested, "sparse_noise", once)


@pytest.fixture
def finer_turns(few_tried, monkeypatch):
    """The cameras are turned by 30 degrees at a time, not by 90."""
    monkeypatch.setattr(tested, "_TURN", 30)


@pytest.mark.usefixtures("few_tried")
def test_a_street_with_default_settings_is_mapped_with_the_noise_that_it_has():
    street = simulate_street(3)
    result = pipeline.run(street.log, FIXED, Ledger())
    (finding,) = result.summary["wrong_input"]
    assert finding["name"] == "noise"
    assert not finding["spoils_positions"]
    said = re.search(r"places that err by about ([\d.]+) m and depths that err by about ([\d.]+) %", finding["message"])
    assert said is not None
    assert [float(number) for number in said.groups()] == pytest.approx([0.71, 15.0], rel=0.2)
    points = np.array([item.position[:2] for item in result.map.resolved()])
    (right, found, twice, of), _ = street_counts(street, points)
    assert right >= 0.85 * found
    assert twice >= 0.85 * of


@pytest.mark.parametrize("told", [True, False])
@pytest.mark.usefixtures("few_tried")
def test_joint_mode_maps_a_street_too(told):
    street = simulate_street(3)
    settings = street.settings(told).model_copy(update={"mode": "joint", "bodies": FIXED.bodies})
    result = pipeline.run(street.log, settings, Ledger())
    points = np.array([item.position[:2] for item in result.map.resolved()])
    (right, found, twice, of), _ = street_counts(street, points)
    assert right >= 0.85 * found
    assert twice >= 0.85 * of
    score = evaluate(result.map, street.log.truth, align="none", radius=4.0).to_dict()
    assert score["inside_95_3d"] >= 0.8


@pytest.mark.usefixtures("finer_turns")
def test_cameras_that_look_elsewhere_are_no_noise():
    turn = lift_se2(np.array([0.0, 0.0, np.radians(40.0)]))
    log = with_poses(simulate_street(3).log, lambda poses: poses @ turn)
    diagnosis = diagnose(log, FIXED, Ledger())
    assert [one.name for one in diagnosis.findings] == ["boxes disagree"]
    assert with_sparse_noise(log, FIXED, diagnosis, Ledger(), silent) == (FIXED, diagnosis)


@pytest.mark.usefixtures("finer_turns")
def test_cameras_that_look_elsewhere_are_named_with_much_noise_in_the_settings():
    turn = lift_se2(np.array([0.0, 0.0, np.radians(30.0)]))
    street = simulate_street(2)
    settings = street.settings(True).model_copy(update={"mode": "fixed"})
    log = with_poses(street.log, lambda poses: poses @ turn)
    said = settings.model_copy(update={"localization": settings.localization.model_copy(update={"xy": 0.6})})
    _, diagnosis = with_sparse_noise(log, said, Diagnosis(), Ledger(), silent)
    assert [(one.name, one.spoils) for one in diagnosis.findings] == [("cameras turned", True)]
    assert "turned by about -30 degrees" in diagnosis.findings[0].message
    assert with_sparse_noise(street.log, said, Diagnosis(), Ledger(), silent) == (said, Diagnosis())


def test_misses_count_against_many_objects_with_few_boxes():
    """By their boxes alone, more objects at exact places explain this street as well. GPS with 2.9 m of noise is true."""
    log = simulate_street(4).log
    exact, noisy = (search_objects(log, FIXED, SparseNoise(place=place, ranges=8.0)) for place in (1.0, 60.0))
    assert noisy.value - exact.value > 10 + abs(noisy.found.chance - exact.found.chance)
    assert noisy.views > exact.views


@pytest.mark.parametrize("noise", [0.02, 1.0])
def test_frames_off_the_path_are_left_to_the_run(noise):
    street = simulate_street(2)
    path = street.log.localization
    log = replace(street.log, localization=replace(path, stamps=path.stamps + 1e4))
    said = FIXED.model_copy(update={"localization": FIXED.localization.model_copy(update={"xy": noise})})
    assert with_sparse_noise(log, said, accused().without(DISAGREE), Ledger(), silent) == (said, Diagnosis())
    assert with_sparse_noise(log, said, accused(), Ledger(), silent) == (said, accused())


@pytest.mark.usefixtures("few_tried")
def test_boxes_without_a_ray_are_no_street():
    street = simulate_street(2)
    cameras = [
        replace(one, detections=replace(one.detections, boxes=one.detections.boxes * 0)) for one in street.log.cameras
    ]
    log, settings = replace(street.log, cameras=tuple(cameras)), street.settings(True)
    said = settings.model_copy(update={"mode": "fixed"})
    assert with_sparse_noise(log, said, Diagnosis(), Ledger(), silent) == (said, Diagnosis())
    assert with_sparse_noise(log, FIXED, accused(), Ledger(), silent) == (FIXED, accused())


@pytest.mark.usefixtures("few_tried")
def test_noise_that_the_settings_say_is_not_changed():
    log = simulate_street(3).log
    said = FIXED.model_copy(update={"localization": FIXED.localization.model_copy(update={"xy": 0.03})})
    assert all(noise.place == 1.0 for noise in sparse_noise(log, said, silent)[0])
    said = FIXED.model_copy(update={"depth": FIXED.depth.model_copy(update={"sigma_per_m": 0.15})})
    (likely, *_), _ = sparse_noise(log, said, silent)
    assert likely.ranges == 1.0
    assert likely.place > 10


def test_few_rays_are_searched_if_nothing_shows_the_shared_errors(monkeypatch):
    def fails(*args):
        raise SolveError("no object shows them")

    monkeypatch.setattr("objslam.graph.calibration.fixed_pose_calibration.calibrate_at_poses", fails)
    street, ledger = simulate_street(3), Ledger()
    settings = street.settings(True)
    asked = settings.model_copy(update={"calibration": settings.calibration.model_copy(update={"use": True})})
    result = pipeline.run(street.log, asked, ledger)
    assert any("no object shows them" in warning for warning in ledger.warnings)
    assert result.map.resolved()
    points = np.array([item.position[:2] for item in result.map.resolved()])
    (_, _, twice, of), _ = street_counts(street, points)
    assert twice >= 0.85 * of


def test_a_street_that_agrees_with_the_settings_is_not_accused():
    """Few points explain most of its boxes, because each thing has few. The noise of the settings explains them best."""
    street = simulate_street(34)
    settings = street.settings(True).model_copy(update={"mode": "fixed"})
    # With places above 0.3 m no check accuses a log. The places of this street err by 0.5 m.
    settings = settings.model_copy(update={"localization": settings.localization.model_copy(update={"xy": 0.29})})
    assert with_sparse_noise(street.log, settings, accused(), Ledger(), silent) == (settings, Diagnosis())


def test_a_log_that_agrees_is_left_alone():
    log = simulate_street(3).log
    diagnosis = replace(diagnose(log, FIXED, Ledger()), findings=())
    assert with_sparse_noise(log, FIXED, diagnosis, Ledger(), silent) == (FIXED, diagnosis)


@pytest.mark.parametrize("place", [0.3, 2.0])
def test_the_residuals_show_the_noise_of_the_places(place):
    """500 objects, four rays each, at their least-squares positions. Restricted likelihood has no bias there."""
    rng, views, count = np.random.default_rng(0), 4, 500
    owner = np.repeat(np.arange(count), views)
    bearing, away = rng.uniform(-np.pi, np.pi, len(owner)), rng.uniform(5.0, 20.0, len(owner))
    ahead = np.column_stack([np.cos(bearing), np.sin(bearing)])
    said = bearing + 0.01 * rng.standard_normal(len(owner))
    range_ = away * (1 + 0.02 * rng.standard_normal(len(owner)))
    origin = -away[:, None] * ahead + place * rng.standard_normal((len(owner), 2))
    ends = origin + range_[:, None] * np.column_stack([np.cos(said), np.sin(said)])
    weight = 1 / (place**2 + (0.015 * away) ** 2)
    best = np.array([np.bincount(owner, weight * ends[:, k]) / np.bincount(owner, weight) for k in range(2)]).T
    level = np.zeros((len(owner), 1))
    of = np.column_stack([best, np.zeros(count)])
    own = np.arange(len(owner))
    found = FewRayEvidence(0.0, 0.0, 1.0, own, owner, own, np.zeros((len(owner), 3)), of)
    searched = Searched(
        SparseNoise(place=10.0),
        found,
        np.hstack([np.column_stack([np.cos(said), np.sin(said)]), level]),
        np.hstack([best[owner] - origin, level]),
        np.zeros((len(owner), 3)),
        np.full(len(owner), 0.01),
        range_,
        0.02 * away,
        0.02,
    )
    noise = noise_of_residuals(searched, (True, False, False), 10.0, shared=False)
    assert 0.02 * noise.place == pytest.approx(place, rel=0.06)


def test_a_long_street_is_searched_in_its_middle():
    log = simulate_street(0).log
    assert middle(log) is log
    boxes = sum(len(one.detections) for one in log.cameras)
    many = replace(log, cameras=log.cameras * 4)
    part = middle(many)
    stamps = np.unique(np.concatenate([one.detections.frame_stamps for one in part.cameras]))
    assert np.diff(stamps).max() == pytest.approx(1.0)
    assert few_box_search._MOST_BOXES <= sum(len(one.detections) for one in part.cameras) < 4 * boxes
    assert stamps[0] > log.cameras[0].detections.frame_stamps[0]
