"""Alignments in space: a map turned any way is laid back onto the truth, and a mirrored one is not."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scenes import CLASSES, a_map, a_truth, numbers, scene
from scipy.spatial.transform import Rotation

from objslam.evaluation.evaluate import evaluate


@settings(max_examples=12)  # One takes 0.2 s.
@given(st.integers(0, 10_000), CLASSES, st.sampled_from(["se3", "sim3"]), st.floats(0.6, 1.8))
def test_a_map_turned_in_space_scores_the_same_after_alignment(seed: int, classes: int, kind: str, scale: float) -> None:
    truth, labels, found, found_labels = scene(seed, classes)
    turn = Rotation.random(random_state=seed).as_matrix()
    s = scale if kind == "sim3" else 1.0
    there = s * found @ turn.T + [100.0, -40.0, 7.0]
    a = evaluate(a_map(found, found_labels), a_truth(truth, labels), align=kind)  # type: ignore[arg-type]
    b = evaluate(a_map(there, found_labels), a_truth(truth, labels), align=kind)  # type: ignore[arg-type]
    assert numbers(b) == pytest.approx(numbers(a), abs=1e-6)
    data = b.to_dict()
    assert (data["matched"], data["missed"], data["false"]) == (10, 2, 2)
    assert {(o["id"] - 10 + 2, o["truth_id"]) for o in data["objects"]} == {(i, i) for i in range(2, 12)}
    assert data["transform"]["scale"] == pytest.approx(1 / s, rel=0.02)
    back = Rotation.from_quat(data["transform"]["rotation_xyzw"])
    assert (back * Rotation.from_matrix(turn)).magnitude() < 0.05


@settings(max_examples=20)
@given(st.integers(0, 10_000), st.sampled_from(["se3", "sim3"]), st.integers(0, 2))
def test_a_mirrored_map_is_never_taken_for_the_truth(seed: int, kind: str, axis: int) -> None:
    truth = np.random.default_rng(seed).uniform(0, 10, (8, 3))
    labels = [f"class {i}" for i in range(8)]
    mirrored = truth * np.where(np.arange(3) == axis, -1.0, 1.0)
    there = mirrored @ Rotation.random(random_state=seed).as_matrix().T
    data = evaluate(a_map(there, labels), a_truth(truth, labels), align=kind).to_dict()  # type: ignore[arg-type]
    assert data["transform"]["scale"] > 0
    assert data["matched"] < 8 or data["position_max"] > 0.1
