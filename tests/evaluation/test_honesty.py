"""Whether covariances hold the truth as often as they say, in the plane and in space, after every alignment."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from rich.console import Console
from scenes import a_map, a_truth, an_object
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from objslam.core.geometry import align, lift_se2
from objslam.core.maps.shared_covariance import jacobian
from objslam.core.object_map import ObjectMap
from objslam.evaluation.aligned_covariances import aligned_covariances
from objslam.evaluation.alignment import Transform
from objslam.evaluation.evaluate import evaluate
from objslam.evaluation.table import evaluation_table


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

    def squared(pose, kind):
        """The distances in space of the map at a pose."""
        at, spread = (places + errors) @ pose.T, pose @ along @ pose.T
        found = (dataclasses.replace(an_object(i, labels[i], at[i]), covariance=spread) for i in range(5))
        data = evaluate(ObjectMap(tuple(found)), a_truth(places, labels), align=kind).to_dict()
        return [row["mahalanobis_3d"] for row in data["objects"]]

    assert squared(np.eye(3), "none") == pytest.approx([1, 1, 0, 0, 0], abs=1e-9)
    assert squared(turn, "se3") == pytest.approx(squared(np.eye(3), "se3"), rel=1e-6)
    assert max(squared(turn, "se3")) < 3  # More than 1, because the alignment takes out a part of such errors.


def a_map_with_shared_errors(rng, shared, count):
    """True places, and a map of them: its places, with errors drawn from the covariances that it gives."""
    places = rng.uniform(-5, 5, (count, 3))
    roots = np.concatenate([rng.normal(scale=0.02, size=(count, 3, 3)), np.tile(0.02 * np.eye(3), (count, 1, 1))], axis=2)
    found = places + (roots @ rng.standard_normal((count, 6, 1)))[..., 0]
    found += jacobian(places) @ rng.multivariate_normal(np.zeros(7), shared)
    moves = jacobian(found)
    return places, found, roots @ np.swapaxes(roots, 1, 2) + moves @ shared @ np.swapaxes(moves, 1, 2)


SHARED = np.diag([0.2, 0.2, 0.05, 0.002, 0.002, 0.05, 0.01]) ** 2
"""A drift of 0.2 m and 3 degrees, and a size of 1 %: what the map of a robot with odometry alone says of itself."""


@pytest.mark.parametrize("kind", ["se2", "sim2", "se3", "sim3"])
def test_what_an_alignment_leaves_is_found_by_its_derivatives(kind):
    """The alignment, derived by numbers, takes the covariance of all errors to that of what is left of them."""
    rng = np.random.default_rng(8)
    pose, scale, count = lift_se2(np.array([3.0, -2.0, 0.7])), 1.3 if "sim" in kind else 1.0, 6
    _, places, covariance = a_map_with_shared_errors(rng, SHARED, count)
    truth = scale * places @ pose[:3, :3].T + pose[:3, 3]
    moves = jacobian(places)
    whole = (moves @ SHARED)[:, None] @ np.swapaxes(moves, 1, 2)
    whole[np.arange(count), np.arange(count)] = covariance
    whole = np.swapaxes(whole, 1, 2).reshape(3 * count, 3 * count)

    def left(errors):
        moved, size = align(places + errors, truth, kind)
        return (size * (places + errors) @ moved[:3, :3].T + moved[:3, 3] - truth).ravel()

    steps = 1e-5 * np.eye(3 * count).reshape(-1, count, 3)
    derived = np.column_stack([(left(step) - left(-step)) / 2e-5 for step in steps])
    expected = (derived @ whole @ derived.T).reshape(count, 3, count, 3)[np.arange(count), :, np.arange(count)]
    found = aligned_covariances(places, covariance, SHARED, Transform(pose, scale), kind)
    np.testing.assert_allclose(found, expected, rtol=1e-4, atol=1e-9)


def test_a_map_that_drifted_as_a_whole_is_judged_by_what_an_alignment_leaves():
    """Odometry alone. Its covariances contain the drift, which the alignment takes out. Neither hides the other."""
    rng, squared, labels = np.random.default_rng(9), [], [f"thing {i}" for i in range(7)]
    for _ in range(120):
        places, found, covariance = a_map_with_shared_errors(rng, SHARED, len(labels))
        rows = enumerate(zip(found, covariance, strict=True))
        objects = tuple(dataclasses.replace(an_object(i, labels[i], at), covariance=cov) for i, (at, cov) in rows)
        scored = evaluate(ObjectMap(objects, shared_covariance=SHARED), a_truth(places, labels), align="se2", radius=5.0)
        assert scored.objects.shared_known
        squared += [m.squared for m in scored.objects.matches]
    assert np.median(squared) == pytest.approx(chi2.median(2), rel=0.1)
    assert np.mean(np.array(squared) < chi2.ppf(0.95, 2)) == pytest.approx(0.95, abs=0.02)
    alone = evaluate(ObjectMap(objects), a_truth(places, labels), align="se2", radius=5.0)
    assert not alone.objects.shared_known
    assert "1.39 or less" in text_of(alone)
    assert "(honest: 1.39)" in text_of(scored)


def text_of(evaluation):
    console = Console(width=120)
    with console.capture() as said:
        console.print(evaluation_table(evaluation))
    return said.get()


def test_two_aligned_objects_say_nothing_of_honesty():
    places, labels = np.array([[0.0, 0, 0], [1, 0, 0]]), ["a", "b"]
    objects = tuple(
        dataclasses.replace(an_object(i, labels[i], at * 1.1), covariance=1e-4 * np.eye(3)) for i, at in enumerate(places)
    )
    assert evaluate(ObjectMap(objects), a_truth(places, labels)).to_dict()["inside_95"] is not None
    assert evaluate(ObjectMap(objects), a_truth(places, labels), align="se2").to_dict()["inside_95"] is None


def test_objects_without_a_covariance_say_nothing_of_honesty():
    places = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]])
    data = evaluate(a_map(places, ["a", "b", "c"]), a_truth(places, ["a", "b", "c"])).to_dict()
    assert data["mahalanobis_median"] is None
    assert data["inside_95"] is data["inside_95_3d"] is None
