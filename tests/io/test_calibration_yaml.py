"""The file of a robot's shared errors: written and read back, refused in one line, and combined from several logs."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

from objslam.core.calibration import Calibration, combine
from objslam.errors import ConfigError
from objslam.io.calibration_yaml import dump_calibration, load_calibration


def a_calibration(seed=0, names=("odometry.scale", "front.clock", "front.yaw")):
    rng = np.random.default_rng(seed)
    root = rng.normal(scale=0.01, size=(len(names), len(names) + 3))
    return Calibration(names, rng.normal(scale=0.02, size=len(names)), root @ root.T, np.full(len(names), 0.1))


def test_a_calibration_comes_back(tmp_path):
    one = a_calibration()
    (tmp_path / "calibration.yaml").write_text(dump_calibration(one))
    again = load_calibration(tmp_path / "calibration.yaml")
    assert again.names == one.names
    for name in ("values", "covariance", "prior"):
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
    ],
)
def test_a_file_that_is_none_is_refused_in_one_line(tmp_path, text):
    file = tmp_path / "calibration.yaml"
    file.write_text(text)
    with pytest.raises(ConfigError) as caught:
        load_calibration(file)
    assert "calibration.yaml" in str(caught.value)
    assert "\n" not in str(caught.value)


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


def test_a_parameter_of_one_log_alone_is_taken_from_it():
    one, other = a_calibration(2, ("odometry.scale",)), a_calibration(3, ("front.clock",))
    together = combine([one, other])
    assert together.names == ("odometry.scale", "front.clock")
    assert_allclose(together.values, np.concatenate([one.values, other.values]), rtol=1e-9)
    assert_allclose(np.diagonal(together.covariance), [one.covariance[0, 0], other.covariance[0, 0]], rtol=1e-9)
