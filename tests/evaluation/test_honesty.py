"""Whether covariances hold the truth as often as they say, in the plane and in space, after every alignment."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from scenes import a_map, a_truth, an_object
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from objslam.core.geometry import lift_se2
from objslam.core.object_map import ObjectMap
from objslam.evaluation.evaluate import evaluate


@pytest.mark.parametrize("kind", ["none", "se2", "sim2", "se3", "sim3"])
def test_honest_covariances_hold_the_truth_as_often_as_they_say(kind):
    """Errors drawn from the covariances themselves: 95 % of them lie inside, and the median is chi-squared's."""
    rng = np.random.default_rng(5)
    pose = np.eye(4) if kind == "none" else lift_se2(np.array([3.0, -2.0, 0.7]))
    if kind in ("se3", "sim3"):
        pose[:3, :3] = Rotation.from_rotvec([1.9, -0.6, 0.8]).as_matrix()
    scale = 1.3 if kind in ("sim2", "sim3") else 1.0
    labels, squared, squared_3d = [f"thing {i}" for i in range(40)], [], []
    for _ in range(30):
        places = rng.uniform(-50, 50, (40, 3))
        # The alignment has an error of its own, so no axis of an ellipsoid is far shorter than that.
        roots = np.concatenate([rng.normal(scale=0.02, size=(40, 3, 3)), np.tile(0.02 * np.eye(3), (40, 1, 1))], axis=2)
        errors = (roots @ rng.standard_normal((40, 6, 1)))[..., 0]
        turned = (places + errors) @ pose[:3, :3].T * scale + pose[:3, 3]
        covariances = scale**2 * pose[:3, :3] @ roots @ np.swapaxes(roots, 1, 2) @ pose[:3, :3].T
        map_ = ObjectMap(
            tuple(
                dataclasses.replace(an_object(i, labels[i], at), covariance=c)
                for i, (at, c) in enumerate(zip(turned, covariances, strict=True))
            )
        )
        data = evaluate(map_, a_truth(places, labels), align=kind).to_dict()
        assert data["matched"] == 40
        one, whole = ([row[name] for row in data["objects"]] for name in ("mahalanobis", "mahalanobis_3d"))
        assert data["inside_95"] == pytest.approx(np.mean(np.array(one) < chi2.ppf(0.95, 2)))
        assert data["inside_95_3d"] == pytest.approx(np.mean(np.array(whole) < chi2.ppf(0.95, 3)))
        assert data["mahalanobis_median"] == pytest.approx(np.median(one))
        squared += one
        squared_3d += whole
    for found, freedom in ((squared, 2), (squared_3d, 3)):
        assert np.mean(np.array(found) < chi2.ppf(0.95, freedom)) == pytest.approx(0.95, abs=0.02)
        assert np.median(found) == pytest.approx(chi2.median(freedom), rel=0.1)


def test_a_covariance_turns_with_its_map():
    """A long thin ellipsoid that points at the truth holds it; a map turned on its side must not change that."""
    places = np.array([[0.0, 0, 0], [10, 0, 0], [0, 10, 0], [0, 0, 10], [10, 10, 3]])
    labels = [f"thing {i}" for i in range(5)]
    along = np.diag([1e-2, 1e-6, 1e-6])
    errors = np.zeros((5, 3))
    errors[0, 0], errors[1, 0] = 0.1, -0.1
    turn = Rotation.from_euler("y", 90, degrees=True).as_matrix()
    map_ = ObjectMap(
        tuple(
            dataclasses.replace(an_object(i, labels[i], turn @ (places[i] + errors[i])), covariance=turn @ along @ turn.T)
            for i in range(5)
        )
    )
    data = evaluate(map_, a_truth(places, labels), align="se3").to_dict()
    expected = [
        row["offset"][0] ** 2 / 1e-2 + (row["offset"][1] ** 2 + row["offset"][2] ** 2) / 1e-6 for row in data["objects"]
    ]
    assert [row["mahalanobis_3d"] for row in data["objects"]] == pytest.approx(expected, rel=1e-6)


def test_objects_without_a_covariance_say_nothing_of_honesty():
    places = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]])
    data = evaluate(a_map(places, ["a", "b", "c"]), a_truth(places, ["a", "b", "c"])).to_dict()
    assert data["mahalanobis_median"] is None
    assert data["inside_95"] is data["inside_95_3d"] is None
