"""A solved path that leaves the localisation for seconds is named, in units of the localisation's own noise."""

from dataclasses import replace
from itertools import accumulate

import numpy as np
import pytest
from small_log import small_log

from objslam.config import Odometry, load_settings
from objslam.core.diagnostics import Ledger
from objslam.core.statistics import WHITE, Lasting
from objslam.mapping import pipeline
from objslam.mapping.joint.path_against_localization import BENT_PATH, check_bent_path, sigmas_of_pieces
from objslam.mapping.stages import described

SIGMA, STAMPS = 0.02, np.arange(0.0, 200.0, 0.25)


def errors_of(lasting, seed, count=len(STAMPS)):
    """Errors of a localisation, (count, 2) m: a lasting part and a white one."""
    rng = np.random.default_rng(seed)
    stays = np.exp(-0.25 / lasting.seconds) if lasting.share else 0.0
    drawn = rng.normal(size=(count, 2))
    new = np.sqrt(1 - stays**2) * drawn
    new[0] = drawn[0]
    lasts = np.stack([list(accumulate(axis.tolist(), lambda last, own: stays * last + own)) for axis in new.T], axis=1)
    white = rng.normal(size=(count, 2))
    return SIGMA * (np.sqrt(lasting.share) * lasts + np.sqrt(1 - lasting.share) * white)


def named(off, sigma=SIGMA, lasting=WHITE):
    sigmas, limit = sigmas_of_pieces(STAMPS, off, np.zeros(len(off)), sigma, lasting)
    return sigmas > limit


@pytest.mark.parametrize("lasting", [WHITE, Lasting(1.0, 10.0), Lasting(0.5, 60.0)])
def test_a_path_that_is_right_is_hardly_ever_named(lasting):
    """Even a path that follows none of the localisation's errors."""
    assert sum(named(errors_of(lasting, seed), lasting=lasting).any() for seed in range(200)) <= 2


def test_a_bend_of_seconds_is_named_where_it_is():
    off = errors_of(Lasting(1.0, 10.0), 0)
    off[(STAMPS >= 100) & (STAMPS < 115), 0] += 0.15
    assert np.flatnonzero(named(off, lasting=Lasting(1.0, 10.0))).tolist() == [20, 21, 22]


def test_the_same_bend_is_no_contradiction_for_a_localisation_that_errs_more():
    off = errors_of(WHITE, 0)
    off[(STAMPS >= 100) & (STAMPS < 115), 0] += 0.15
    assert named(off).sum() == 3
    assert not named(off, sigma=0.1, lasting=Lasting(1.0, 30.0)).any()


def test_single_jumps_are_no_bend():
    off = errors_of(WHITE, 1)
    off[::9] += 1.0
    assert not named(off).any()


def test_errors_that_the_odometry_adds_count():
    off = np.zeros((len(STAMPS), 2))
    off[:20, 1] = 0.15
    for carried, found in ((0.0, True), (1.0, False)):
        sigmas, limit = sigmas_of_pieces(STAMPS, off, np.full(len(off), carried), SIGMA, WHITE)
        assert (sigmas[0] > limit) == found


def test_a_piece_with_few_poses_is_not_judged():
    sigmas, _ = sigmas_of_pieces(np.array([0.0, 1.0, 6.0, 7.0, 8.0]), np.ones((5, 2)), np.zeros(5), SIGMA, WHITE)
    assert np.isnan(sigmas[0])
    assert sigmas[1] > 10


def test_a_jump_of_the_stamps_costs_nothing():
    sigmas, _ = sigmas_of_pieces(
        np.append(np.arange(4.0), 1.7e9 + np.arange(4.0)), np.ones((8, 2)), np.zeros(8), SIGMA, WHITE
    )
    assert len(sigmas) == 2


@pytest.mark.parametrize("bend", [0.0, 1.0])
def test_a_run_names_the_path_that_is_bent(bend, monkeypatch):
    """A third of the solved path is moved before it is compared."""

    def bent(solution, errors, settings):
        path = solution.estimate.map_T_base.copy()
        path[: len(path) // 3, 0, 3] += bend
        moved = replace(solution, estimate=replace(solution.estimate, map_T_base=path))
        return check_bent_path(moved, errors, settings)

    monkeypatch.setattr(described, "check_bent_path", bent)
    result = pipeline.run(
        small_log(odometry=Odometry()), load_settings(None, ("mode=joint", "output.recording=false")), Ledger()
    )
    found = [one for one in result.summary["wrong_input"] if one["name"] == BENT_PATH]
    assert len(found) == bool(bend)
    assert any("from the localisation" in one for one in result.summary["warnings"]) == bool(bend)
