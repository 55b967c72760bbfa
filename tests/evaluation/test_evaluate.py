"""The comparison with the ground truth: exact counts where they are known, and what must not change it."""

from __future__ import annotations

import dataclasses
import itertools
import json
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scenes import CLASSES, a_map, a_path, a_truth, an_object, numbers, scene, show
from scipy.optimize import minimize
from scipy.spatial.transform import Rotation

from objslam.core.arrays import Floats
from objslam.core.geometry import lift_se2
from objslam.core.object_map import ObjectMap
from objslam.core.trajectory import Trajectory
from objslam.core.types import Truth
from objslam.errors import ConfigError, LogError
from objslam.evaluation.alignment import match_points
from objslam.evaluation.evaluate import evaluate
from objslam.evaluation.evaluate_folder import write_evaluation


def moved(trajectory: Trajectory, pose: Floats, scale: float = 1.0) -> Trajectory:
    poses = pose @ trajectory.poses
    poses[:, :3, 3] = scale * trajectory.poses[:, :3, 3] @ pose[:3, :3].T + pose[:3, 3]
    return Trajectory(trajectory.stamps, poses)


def test_exact_counts() -> None:
    truth = a_truth([[0, 0, 0], [1, 0, 0], [5, 5, 0], [9, 0, 1]], ["cup", "cup", "book", "cup"])
    found = ObjectMap(
        (
            an_object(1, "cup", [0.3, 0, 0]),  # the first cup, 0.3 m off
            an_object(2, "cup", [1, 0.4, 0]),  # the second, 0.4 m off
            an_object(3, "cup", [0.9, 0, 0]),  # nearer to the second, but then the first object above has nobody: false
            an_object(4, "cup", [5, 5, 0]),  # right there, the label is wrong: false, and the book is missed
            an_object(5, "cup", [9, 0, 1], "unresolved"),
        )
    )
    scores = evaluate(found, truth).objects
    assert scores is not None
    assert {(m.object.id, m.truth.id) for m in scores.matches} == {(1, 0), (3, 1)}
    assert {o.id for o in scores.missed} == {2, 3}
    assert {o.id for o in scores.false} == {2, 4}
    assert scores.unresolved == 1
    data = evaluate(found, truth).to_dict()
    assert (data["matched"], data["missed"], data["false"], data["unresolved"]) == (2, 2, 2, 1)
    assert (data["precision"], data["recall"]) == (0.5, 0.5)
    assert data["position_rmse"] == pytest.approx(np.sqrt((0.09 + 0.01) / 2))
    assert data["position_median"] == pytest.approx(0.2)
    assert data["position_max"] == pytest.approx(0.3)
    first = next(o for o in data["objects"] if o["id"] == 1)
    assert first == {
        "id": 1,
        "truth_id": 0,
        "label": "cup",
        "error": pytest.approx(0.3),
        "mahalanobis": None,
        "mahalanobis_3d": None,
        "offset": pytest.approx([0.3, 0, 0]),
    }
    assert data["missed_objects"] == [{"truth_id": 2, "label": "book"}, {"truth_id": 3, "label": "cup"}]


def test_the_radius_bounds_a_match_and_is_part_of_it() -> None:
    truth = a_truth([[0, 0, 0]], ["cup"])
    found = a_map([[0.5, 0, 0]], ["cup"])
    assert evaluate(found, truth).to_dict()["matched"] == 1
    assert evaluate(found, truth, radius=0.49).to_dict()["matched"] == 0
    assert evaluate(a_map([[0, 0, 0.6]], ["cup"]), truth).to_dict()["matched"] == 0
    for radius in (0.0, -1.0, float("nan")):
        with pytest.raises(ConfigError, match="radius"):
            evaluate(found, truth, radius=radius)


@given(st.integers(0, 2**32 - 1), st.integers(0, 5), st.integers(0, 5))
def test_matching_is_the_best_of_all_one_to_one_choices(seed: int, n: int, m: int) -> None:
    rng = np.random.default_rng(seed)
    a, b = rng.uniform(0, 1.5, (n, 3)), rng.uniform(0, 1.5, (m, 3))
    same = rng.integers(2, size=n)[:, None] == rng.integers(2, size=m)[None]
    radius = 0.8
    best = (0, 0.0)
    small, large = sorted((n, m))
    for chosen in itertools.permutations(range(large), small):
        pairs = [(i, k) if n <= m else (k, i) for i, k in enumerate(chosen)]
        squared = [((a[i] - b[k]) ** 2).sum() for i, k in pairs if same[i, k] and np.linalg.norm(a[i] - b[k]) <= radius]
        best = min(best, (-len(squared), sum(squared)))
    rows, columns = match_points(a, b, same, radius)
    assert len(set(rows)) == len(set(columns)) == len(rows) == -best[0]
    assert same[rows, columns].all()
    assert float(((a[rows] - b[columns]) ** 2).sum()) == pytest.approx(best[1])


KINDS = st.sampled_from(["none", "se2", "sim2", "se3", "sim3"])


@settings(max_examples=25)
@given(st.integers(0, 10_000), CLASSES, KINDS)
def test_the_order_of_objects_does_not_matter(seed: int, classes: int, kind: str) -> None:
    truth, labels, found, found_labels = scene(seed, classes)
    objects, true = a_map(found, found_labels), a_truth(truth, labels)
    rng = np.random.default_rng(seed)
    shuffled = ObjectMap(tuple(objects.objects[i] for i in rng.permutation(len(objects))))
    true_shuffled = Truth(tuple(true.objects[i] for i in rng.permutation(len(true.objects))))
    a = evaluate(objects, true, align=kind).to_dict()  # type: ignore[arg-type]
    b = evaluate(shuffled, true_shuffled, align=kind).to_dict()  # type: ignore[arg-type]
    assert a == b


@settings(max_examples=40)
@given(st.integers(0, 10_000), CLASSES, st.sampled_from(["se2", "sim2"]), st.floats(-3.1, 3.1), st.floats(0.6, 1.8))
def test_a_moved_map_scores_the_same_after_alignment(seed: int, classes: int, kind: str, yaw: float, scale: float) -> None:
    truth, labels, found, found_labels = scene(seed, classes)
    pose = lift_se2(np.array([100.0, -40.0, yaw]))
    pose[2, 3] = 0.7
    s = scale if kind == "sim2" else 1.0
    there = s * found @ pose[:3, :3].T + pose[:3, 3]
    a = evaluate(a_map(found, found_labels), a_truth(truth, labels), align=kind)  # type: ignore[arg-type]
    b = evaluate(a_map(there, found_labels), a_truth(truth, labels), align=kind)  # type: ignore[arg-type]
    assert numbers(b) == pytest.approx(numbers(a), abs=1e-6)
    data = b.to_dict()
    assert (data["matched"], data["missed"], data["false"]) == (10, 2, 2)
    assert data["position_max"] < 0.15
    assert {(o["id"] - 10 + 2, o["truth_id"]) for o in data["objects"]} == {(i, i) for i in range(2, 12)}
    assert data["transform"]["scale"] == pytest.approx(1 / s, rel=0.02)
    turn = Rotation.from_euler("z", data["transform"]["yaw_deg"] + np.degrees(yaw), degrees=True)
    assert turn.magnitude() < 0.02


def test_alignment_is_the_least_squares_optimum() -> None:
    truth, labels, found, found_labels = scene(3, 12)
    scores = evaluate(a_map(found, found_labels), a_truth(truth, labels), align="sim2").objects
    assert scores is not None
    ours = np.stack([m.object.position for m in scores.matches])
    theirs = np.stack([m.truth.position for m in scores.matches])

    def cost(x: Floats) -> float:
        c, s = np.cos(x[0]), np.sin(x[0])
        rotation = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
        return float(((x[4] * ours @ rotation.T + x[1:4] - theirs)[:, :2] ** 2).sum())

    best = minimize(cost, [0, 0, 0, 0, 1], tol=1e-12)
    found_cost = float((np.stack([m.offset for m in scores.matches])[:, :2] ** 2).sum())
    assert found_cost == pytest.approx(best.fun, rel=1e-5)


def test_where_labels_repeat_the_path_decides_between_answers_that_look_alike() -> None:
    # four cups in nearly a square; the map is that square a quarter turn on, so a quarter turn back would fit perfectly
    corners = np.array([[0.1, 0, 0], [4, 0.2, 0], [4, 4, 0], [0, 3.9, 0]])
    quarter = (corners - [2, 2, 0]) @ lift_se2(np.array([0, 0, np.pi / 2]))[:3, :3].T + [2, 2, 0]
    path = a_path()
    turned = lift_se2(np.array([7.0, 2.0, 2.0]))
    found = a_map(quarter @ turned[:3, :3].T + turned[:3, 3], ["cup"] * 4)
    alone = evaluate(found, a_truth(corners, ["cup"] * 4), align="se2").to_dict()
    assert [(o["id"], o["truth_id"]) for o in alone["objects"]] == [(10, 0), (11, 1), (12, 2), (13, 3)]
    assert alone["position_max"] == pytest.approx(0, abs=1e-9)
    data = evaluate(found, a_truth(corners, ["cup"] * 4, path), moved(path, turned), align="se2").to_dict()
    assert [(o["id"], o["truth_id"]) for o in data["objects"]] == [(10, 1), (11, 2), (12, 3), (13, 0)]
    assert 0.05 < data["position_max"] < 0.25
    assert data["ate"] == pytest.approx(0, abs=1e-9)
    assert data["ate_in_map_alignment"] < 0.2


def test_one_wrong_landmark_does_not_move_the_alignment() -> None:
    truth, labels, _, _ = scene(5, 12)
    found = truth.copy()
    found[4] += [3.0, -2.0, 0.0]
    data = evaluate(a_map(found, labels), a_truth(truth, labels), align="se2").to_dict()
    assert (data["matched"], data["missed"], data["false"]) == (11, 1, 1)
    assert data["position_max"] == pytest.approx(0, abs=1e-9)


@pytest.mark.parametrize("kind", ["none", "se2", "sim2", "se3", "sim3"])
def test_nothing_matched_has_no_numbers(kind: str, tmp_path: Path) -> None:
    truth = a_truth([[0, 0, 0], [1, 1, 1]], ["cup", "cup"])
    for found in (ObjectMap(()), a_map([[0, 0, 0]], ["book"]), ObjectMap((an_object(0, "cup", [0, 0, 0], "unresolved"),))):
        evaluation = evaluate(found, truth, align=kind)  # type: ignore[arg-type]
        write_evaluation(evaluation, tmp_path)
        text = (tmp_path / "evaluation.json").read_text()
        assert "NaN" not in text
        data = json.loads(text)
        assert (data["matched"], data["missed"], data["recall"]) == (0, 2, 0.0)
        assert data["precision"] == (None if not found.resolved() else 0.0)
        assert data["position_rmse"] is data["position_median"] is data["position_max"] is data["ate"] is None
        show(evaluation)


def test_one_match_aligned_by_itself_is_no_measure_and_says_so() -> None:
    truth = a_truth([[0, 0, 0], [5, 5, 5]], ["cup", "book"])
    evaluation = evaluate(a_map([[70, 0, 3]], ["cup"]), truth, align="se2")
    assert evaluation.to_dict()["matched"] == 1
    assert "rests on 1 matched object" in evaluation.warnings[0]
    assert evaluate(a_map([[0, 0, 0.1]], ["cup"]), truth).warnings == ()


def test_labels_that_the_truth_does_not_have_are_named() -> None:
    found, truth = a_map([[0, 0, 0], [1, 0, 0]], ["0", "1"]), a_truth([[0, 0, 0], [1, 0, 0]], ["cup", "mug"])
    (warning,) = evaluate(found, truth).warnings
    assert warning == "the map and the truth have no label in common: 0, 1 in the map, cup, mug in the truth"


def test_a_map_scaled_out_of_reason_is_warned_of() -> None:
    truth, labels, _, _ = scene(1, 12)
    evaluation = evaluate(a_map(truth * 4, labels), a_truth(truth, labels), align="sim2")
    assert evaluation.to_dict()["matched"] == 12
    assert "scaled by 0.25" in evaluation.warnings[0]


@pytest.mark.parametrize("truth", [None, Truth(), Truth((), a_path())])
def test_no_truth_is_one_line(truth: Truth | None) -> None:
    with pytest.raises(LogError) as caught:
        evaluate(a_map([[0, 0, 0]], ["cup"]), truth)
    assert str(caught.value) == "no ground truth (give --truth FILE)"


def test_the_ate_without_alignment_is_the_plain_rmse() -> None:
    path = a_path()
    off = path.poses.copy()
    off[:, :3, 3] += np.random.default_rng(1).normal(size=(len(path), 3))
    evaluation = evaluate(ObjectMap(()), Truth((), path), Trajectory(path.stamps, off))
    errors = np.linalg.norm(off[:, :3, 3] - path.poses[:, :3, 3], axis=1)
    data = evaluation.to_dict()
    assert data["ate"] == pytest.approx(np.sqrt((errors**2).mean()))
    assert data["ate_median"] == pytest.approx(np.median(errors))
    assert data["ate_max"] == pytest.approx(errors.max())
    assert data["matched"] is None
    assert data["ate_in_map_alignment"] is None


@pytest.mark.parametrize(("kind", "scale"), [("se2", 1.0), ("sim2", 1.3)])
def test_the_ate_is_aligned_by_the_path_itself(kind: str, scale: float) -> None:
    path = a_path()
    there = moved(path, lift_se2(np.array([3.0, -8.0, 1.2])), scale)
    data = evaluate(ObjectMap(()), Truth((), path), there, align=kind).to_dict()  # type: ignore[arg-type]
    assert data["ate"] == pytest.approx(0, abs=1e-9)
    assert data["path_transform"]["scale"] == pytest.approx(1 / scale)
    assert data["path_transform"]["yaw_deg"] == pytest.approx(-np.degrees(1.2))
    assert evaluate(ObjectMap(()), Truth((), path), there).to_dict()["ate"] > 3


def test_the_truth_is_interpolated_and_stamps_without_it_are_counted() -> None:
    stamps = np.array([0.0, 1.0, 2.0, 10.0, 11.0])
    line = Trajectory(stamps, lift_se2(np.column_stack([stamps, 0 * stamps, 0 * stamps])))
    ours = np.array([-0.5, 0.5, 1.25, 5.0, 10.5, 12.0])  # before, in, in, in a gap, in, after
    path = Trajectory(ours, lift_se2(np.column_stack([ours, 0 * ours + 0.25, 0 * ours])))
    data = evaluate(ObjectMap(()), Truth((), line), path).to_dict()
    assert data["ate"] == pytest.approx(0.25)
    assert (data["path_poses"], data["path_poses_without_truth"]) == (3, 3)


def test_paths_on_different_clocks_are_named() -> None:
    path = a_path()
    late = Trajectory(path.stamps + 1e9, path.poses)
    evaluation = evaluate(ObjectMap(()), Truth((), path), late, align="se2")
    assert evaluation.to_dict()["ate"] is None
    assert "clock" in evaluation.warnings[0]
    show(evaluation)


def test_objects_without_a_path_and_the_other_way_round() -> None:
    truth, labels, found, found_labels = scene(2, 3)
    alone = evaluate(a_map(found, found_labels), a_truth(truth, labels)).to_dict()
    assert alone["ate"] is None
    with_path = evaluate(a_map(found, found_labels), a_truth(truth, labels, a_path()), a_path()).to_dict()
    assert [with_path["ate"], with_path["ate_in_map_alignment"]] == pytest.approx([0, 0], abs=1e-12)
    assert {k: with_path[k] for k in alone if "path" not in k and "ate" not in k} == {
        k: v for k, v in alone.items() if "path" not in k and "ate" not in k
    }


def test_the_table_shows_scores_and_the_worst_object_first() -> None:
    truth = a_truth([[0, 0, 0], [1, 0, 0], [2, 0, 0]], ["cup", "[red]book", "pen"], a_path())
    found = a_map([[0.1, 0, 0], [1.3, 0, 0], [9, 9, 9]], ["cup", "[red]book", "pen"])
    text = show(evaluate(found, truth, a_path()))
    rows = [[cell.strip() for cell in line.strip("│ ").split("│")] for line in text.splitlines() if "│" in line]
    assert ["matched objects", "2"] in rows
    assert ["position RMSE", "0.224 m"] in rows
    assert ["ATE (RMSE)", "0.000 m"] in rows
    listing = [row for row in rows if len(row) == 4]
    assert listing == [
        ["11", "1", "[red]book", "0.300"],
        ["10", "0", "cup", "0.100"],
        ["-", "2", "pen", "missed"],
        ["12", "-", "pen", "false"],
    ]
    alone = show(evaluate(found, dataclasses.replace(truth, trajectory=None)))
    assert "ATE" not in alone
    assert "matched" not in show(evaluate(found, Truth((), a_path()), a_path()))
