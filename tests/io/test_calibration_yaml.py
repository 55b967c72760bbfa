"""The file of a robot's shared errors: written and read back, refused in one line, and combined from several logs."""

import json
from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose

from objslam.core.calibration import Calibration, combine
from objslam.errors import ConfigError
from objslam.io.calibration_yaml import dump_calibration, load_calibration

TWO = "parameters: {a.clock: {value: 0, prior_sigma: 1}, b.clock: {value: 0, prior_sigma: 1}}\n"


def a_calibration(seed=0, names=("odometry.scale", "front.clock", "front.yaw")):
    rng = np.random.default_rng(seed)
    root = rng.normal(scale=0.01, size=(len(names), len(names) + 3))
    return Calibration(names, rng.normal(scale=0.02, size=len(names)), root @ root.T, np.full(len(names), 0.1))


def test_a_calibration_comes_back(tmp_path):
    one = a_calibration()
    (tmp_path / "calibration.yaml").write_text(dump_calibration(one))
    again = load_calibration(tmp_path / "calibration.yaml")
    assert again.names == one.names
    for name in ("values", "covariance", "prior", "expected", "before"):
        assert_allclose(getattr(again, name), getattr(one, name), rtol=1e-12)


def test_the_prior_and_the_summary_of_a_run_come_back(tmp_path):
    mean, before = np.array([0.01, 0.1, -0.02]), np.diag([0.1, 0.1, 0.1]) ** 2 + 0.001
    one = replace(a_calibration(), prior=np.sqrt(np.diagonal(before)), prior_mean=mean, prior_covariance=before)
    (tmp_path / "calibration.yaml").write_text(dump_calibration(one))
    (tmp_path / "summary.json").write_text(json.dumps({"log": "drive", "calibration": one.to_dict()}, indent=2))
    for file in ("calibration.yaml", "summary.json"):
        again = load_calibration(tmp_path / file)
        for name in ("values", "covariance", "prior", "expected", "before"):
            assert_allclose(getattr(again, name), getattr(one, name), rtol=1e-12)


@pytest.mark.parametrize(
    "text",
    [
        "",
        "[1, 2]",
        "parameters: {}",
        "parameters: {a.clock: {value: x, prior_sigma: 1}}\ncovariance: [[1]]",
        "parameters: {a.clock: {value: 0, prior_sigma: 1}}\ncovariance: [[-1]]",
        "parameters: {a.clock: {value: 0, prior_sigma: 1}}\ncovariance: [[1, 2]]",
        "parameters: {a.clock: {value: .nan, prior_sigma: 1}}\ncovariance: [[1]]",
        "parameters: {a.clock: {value: 0, prior_sigma: 0}}\ncovariance: [[1]]",
        "a: [",
        "parameters: {}\ncovariance: []",
        "calibration: null",
        "parameters: {a.clock: {value: 0, prior_sigma: .inf}}\ncovariance: [[1]]",
        "parameters: {a.clock: {value: true, prior_sigma: 1}}\ncovariance: [[1]]",
        "parameters: {a.clock: {value: 0, prior_sigma: 1}}\ncovariance: [[.nan]]",
        "parameters: {a.clock: {value: 0, prior_sigma: 1}}\ncovariance: [[1]]\nprior_covariance: [[0]]",
        "parameters: {a.clock: {value: 0, prior_sigma: 1}, a.clock: {value: 1, prior_sigma: 1}}\ncovariance: [[1]]",
        TWO + "covariance: [[1, 0.5], [0, 1]]",
        TWO + "covariance: [[1, 2], [2, 1]]",
        "parameters: {odometry.scale: {value: -1.2, prior_sigma: 1}}\ncovariance: [[1]]",
        "#" + " " * (1 << 20) + "\nparameters: {a.clock: {value: 0, prior_sigma: 1}}\ncovariance: [[1]]",
        "? [1, 2]\n: 3",
    ],
)
def test_a_file_that_is_none_is_refused_in_one_line(tmp_path, text):
    file = tmp_path / "calibration.yaml"
    file.write_text(text)
    with pytest.raises(ConfigError) as caught:
        load_calibration(file)
    assert "calibration.yaml" in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("there", [False, True])
def test_a_file_that_cannot_be_read_is_named(tmp_path, there):
    file = tmp_path / "calibration.yaml"
    if there:
        file.mkdir()
    with pytest.raises(ConfigError, match=r"calibration\.yaml"):
        load_calibration(file)


def test_logs_add_their_information_and_the_prior_counts_once():
    """Against the closed form for measurements of the parameters themselves."""
    rng = np.random.default_rng(1)
    prior = np.array([0.1, 0.2])
    told = [(rng.normal(scale=0.1, size=2), np.diag(rng.uniform(50, 500, 2))) for _ in range(3)]
    parts = []
    for values, information in told:
        covariance = np.linalg.inv(information + np.diag(prior**-2))
        parts.append(Calibration(("a.clock", "a.yaw"), covariance @ information @ values, covariance, prior))
    together = combine(parts)
    covariance = np.linalg.inv(sum(information for _, information in told) + np.diag(prior**-2))
    assert_allclose(together.covariance, covariance, rtol=1e-9)
    assert_allclose(together.values, covariance @ sum(information @ values for values, information in told), rtol=1e-9)


def posterior(names, prior, told):
    """What a log finds that tells `told` (values, information) of its parameters, with a prior (mean, covariance)."""
    (mean, before), (values, information) = prior, told
    covariance = np.linalg.inv(information + np.linalg.inv(before))
    found = covariance @ (information @ values + np.linalg.solve(before, mean))
    return Calibration(names, found, covariance, np.sqrt(np.diagonal(before)), mean, before)


def test_a_prior_that_the_logs_share_counts_once_whatever_it_is():
    """Logs solved from one file: its mean and its correlations are no news of any of them."""
    rng = np.random.default_rng(4)
    root = rng.normal(scale=0.1, size=(3, 5))
    mean, before, names = rng.normal(scale=0.1, size=3), root @ root.T, ("s", "a.yaw", "b.yaw")
    told = [(rng.normal(scale=0.1, size=3), np.diag(rng.uniform(50, 500, 3))) for _ in range(3)]
    together = combine([posterior(names, (mean, before), one) for one in told])
    covariance = np.linalg.inv(sum(information for _, information in told) + np.linalg.inv(before))
    vector = sum(information @ values for values, information in told) + np.linalg.solve(before, mean)
    assert_allclose(together.covariance, covariance, rtol=1e-9)
    assert_allclose(together.values, covariance @ vector, rtol=1e-9)
    assert_allclose(together.before, before, rtol=1e-9)
    assert_allclose(together.expected, mean, rtol=1e-9)


def test_logs_with_other_parameters_share_the_prior_of_what_both_have():
    """One log has camera a, the other camera b. Given the odometry, the prior knew of no tie between the two."""
    rng = np.random.default_rng(5)
    tie = np.array([1.0, 0.9, 0.95])
    before = 0.01 * (np.outer(tie, tie) + np.diag(1 - tie**2))
    mean, names = np.array([0.05, -0.1, 0.02]), ("s", "a.yaw", "b.yaw")
    parts, total, vector = [], np.linalg.inv(before), np.linalg.solve(before, mean)
    for at in ([0, 1], [0, 2]):
        told = rng.normal(scale=0.1, size=2), np.diag(rng.uniform(50, 500, 2))
        parts.append(posterior(tuple(names[i] for i in at), (mean[at], before[np.ix_(at, at)]), told))
        total[np.ix_(at, at)] += told[1]
        vector[at] += told[1] @ told[0]
    together = combine(parts)
    assert together.names == names
    assert_allclose(together.covariance, np.linalg.inv(total), rtol=1e-8)
    assert_allclose(together.values, np.linalg.solve(total, vector), rtol=1e-8)


def test_a_log_that_tells_nothing_changes_nothing():
    mean, before, names = np.array([0.1, -0.2]), np.diag([0.01, 0.02]), ("a.clock", "a.yaw")
    told = np.array([0.3, 0.1]), np.diag([500.0, 100.0])
    one, silent = posterior(names, (mean, before), told), posterior(names, (mean, before), (told[0], np.zeros((2, 2))))
    together = combine([one, silent])
    assert_allclose(together.values, one.values, rtol=1e-9)
    assert_allclose(together.covariance, one.covariance, rtol=1e-9)


def test_a_parameter_of_one_log_alone_is_taken_from_it():
    one, other = a_calibration(2, ("odometry.scale",)), a_calibration(3, ("front.clock",))
    together = combine([one, other])
    assert together.names == ("odometry.scale", "front.clock")
    assert_allclose(together.values, np.concatenate([one.values, other.values]), rtol=1e-9)
    assert_allclose(np.diagonal(together.covariance), [one.covariance[0, 0], other.covariance[0, 0]], rtol=1e-9)
