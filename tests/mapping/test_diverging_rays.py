"""Labels of several things each, which rays in diverging directions show without a solve."""

from functools import cache

import numpy as np
import pytest
from added_errors import add_shared_errors
from bench_robots import robot
from hypothesis import given
from hypothesis import strategies as st
from log_parts import with_classes
from turning_drive import errors_of

from objslam.config import load_settings
from objslam.core.diagnostics import Ledger
from objslam.evaluation.evaluate import evaluate
from objslam.mapping import joint_solve, pipeline
from objslam.mapping.joint.diverging_rays import angles_to_ray, labels_diverge


@given(st.integers(0, 2**32 - 1))
def test_the_angle_is_the_smallest_to_any_place_on_the_ray(seed):
    rng = np.random.default_rng(seed)
    origin, seen_from = rng.normal(0, 2, (2, 3))
    direction, look = (v / np.linalg.norm(v) for v in rng.normal(size=(2, 3)))
    to = origin + np.geomspace(1e-5, 1e6, 20_001)[:, None] * direction - seen_from
    angles = np.arccos(np.clip(to @ look / np.linalg.norm(to, axis=1), -1, 1))
    found = angles_to_ray(*(a[None] for a in (origin, direction, seen_from, look)))
    assert found[0] == pytest.approx(angles.min(), abs=2e-3)


def test_rays_from_one_place_are_compared_by_their_directions():
    here, ahead, left = np.zeros((1, 3)), np.array([[1.0, 0, 0]]), np.array([[0, 1.0, 0]])
    assert angles_to_ray(here, ahead, here, left)[0] == pytest.approx(np.pi / 2)
    assert angles_to_ray(here, ahead, here, ahead)[0] == 0
    assert angles_to_ray(here, ahead, here - ahead, ahead)[0] == 0


@cache
def of_robot(seed: int):
    """The log of a robot with a gyroscope."""
    return robot(seed, "gyro")[0]


@pytest.mark.parametrize("errors", [{}, {"front.clock": 0.5}, {"front.clock": -0.5}, {"odometry.turn_scale": 0.2}], ids=str)
def test_names_are_no_classes_whatever_the_errors(errors):
    log = add_shared_errors(of_robot(9003), errors)
    found = errors_of(log, "mode=joint")
    assert not labels_diverge(found.keyframes, found.rays)
    assert not labels_diverge(found.keyframes, found.rays.take(np.zeros(len(found.rays), dtype=bool)))


def test_a_log_whose_labels_have_several_things_takes_no_solve_of_names(monkeypatch):
    monkeypatch.setattr(joint_solve, "by_label", lambda state: pytest.fail("labels were solved as names"))
    log = with_classes(of_robot(9004), 5, 9004)
    result = pipeline.run(log, load_settings(None, ("mode=joint", "output.recording=false", "bodies.use=false")), Ledger())
    compared = evaluate(result.map, log.truth, align="se2", radius=0.5).to_dict()
    assert tuple(compared[name] for name in ("matched", "false", "missed")) == (8, 0, 0)


def test_the_setting_that_labels_are_names_counts(monkeypatch):
    called = []

    def by_label(state):
        called.append(state)
        raise RuntimeError

    monkeypatch.setattr(joint_solve, "by_label", by_label)
    log = with_classes(of_robot(9004), 5, 9004)
    with pytest.raises(RuntimeError):
        pipeline.run(log, load_settings(None, ("mode=joint", "association.method=by_label")), Ledger())
    assert called
