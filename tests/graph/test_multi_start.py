"""Joint solves that begin at several growing graphs."""

from dataclasses import replace

import numpy as np
import pytest
from graph.drives import drive_of

from objslam.config import load_settings
from objslam.errors import SolveError
from objslam.graph import multi_start
from objslam.graph.assembly import Measurements
from objslam.graph.multi_start import MultiStart
from objslam.graph.outlier_rejection import JointSolution
from objslam.simulation import preset, simulate


@pytest.fixture
def begun(monkeypatch):
    """A drive, and starts whose growth takes no time: the true path, and one landmark some metres off."""
    log = simulate(preset("demo", localization=None), 0)
    made = drive_of(log, load_settings(None, ("mode=joint",)))
    measured = Measurements.of(made.keyframes, made.rays, made.settings)
    shifts = {4.0: 0.0, 16.0: 0.0}

    def grown(measured, association, progress, trace):
        shift = shifts[measured.settings.joint.min_parallax_deg]
        if shift is None:
            raise SolveError("indeterminate")
        return measured.keyframes.map_T_camera, made.points + [shift, 0, 0] * (np.arange(len(made.points)) == 1)[:, None]

    monkeypatch.setattr(multi_start, "initialize_known", grown)
    return made, measured, shifts


def solution(made, shift):
    points = made.points + [shift, 0, 0] * (np.arange(len(made.points)) == 1)[:, None]
    return JointSolution(made.keyframes.map_T_camera, points, np.ones(len(made.rays), dtype=bool), None, 0.0, 1)


def best(begun, measured, misfits, solved=None):
    """The shift of the solution that is chosen. misfits: by shift. solved: gets the shift of each start that is solved."""
    made = begun[0]

    def shift_of(one):
        return round(float(one.positions[1, 0] - made.points[1, 0]), 6)

    def solve(poses, points, trace):
        shift = float(points[1, 0] - made.points[1, 0])
        if solved is not None:
            solved.append(shift)
        return solution(made, shift)

    start = MultiStart(measured, made.association, solve, lambda one: misfits[shift_of(one)])
    return shift_of(start.best(solution(made, 0.0)))


def test_the_start_with_the_least_misfit_counts(begun):
    _, measured, shifts = begun
    shifts.update({4.0: 2.0, 16.0: -3.0})
    assert best(begun, measured, {0.0: 500.0, 2.0: 400.0, -3.0: 450.0}) == 2.0
    assert best(begun, measured, {0.0: 500.0, 2.0: 600.0, -3.0: 450.0}) == -3.0
    assert best(begun, measured, {0.0: 500.0, 2.0: 498.0, -3.0: 501.0}) == 0.0  # not clearly better


def test_a_start_that_ends_in_the_same_minimum_or_fails_is_no_other_start(begun):
    _, measured, shifts = begun
    shifts.update({4.0: 0.01, 16.0: None})
    assert best(begun, measured, {}) == 0.0  # There is nothing to compare.
    shifts.update({4.0: None, 16.0: 0.01})
    assert best(begun, measured, {}) == 0.0


def test_a_graph_that_grew_into_a_known_minimum_is_not_solved(begun):
    _, measured, shifts = begun
    shifts.update({4.0: 0.01, 16.0: 2.0})
    solved = []
    assert best(begun, measured, {0.0: 500.0, 2.0: 400.0}, solved) == 2.0
    assert solved == pytest.approx([2.0])


def test_a_long_log_begins_again_until_two_starts_agree(begun, monkeypatch):
    _, measured, shifts = begun
    monkeypatch.setattr(multi_start, "_FEW_RAYS", 10)
    shifts.update({4.0: 0.01, 16.0: 2.0})
    assert best(begun, measured, {}) == 0.0
    shifts.update({4.0: 2.0, 16.0: -3.0})
    assert best(begun, measured, {0.0: 500.0, 2.0: 450.0, -3.0: 400.0}) == -3.0


def test_ranges_need_no_other_start(begun):
    _, measured, shifts = begun
    shifts.update({4.0: 2.0, 16.0: 2.0})
    rays = measured.rays
    ranged = replace(measured, rays=replace(rays, range=np.full(len(rays), 2.0)))
    assert best(begun, ranged, {0.0: 500.0, 2.0: 400.0}) == 0.0
