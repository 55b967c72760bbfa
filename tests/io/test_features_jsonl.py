"""Appearance vectors in detections.jsonl, from there to the rays, and in features.parquet."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from objslam.api.inputs import Detections
from objslam.config import Settings
from objslam.core.diagnostics import Ledger
from objslam.core.trajectory import Trajectory
from objslam.core.types import CameraLog, Log
from objslam.errors import OutputError
from objslam.frontend.bearings import build_rays
from objslam.frontend.keyframes import build_keyframes
from objslam.io.box_collector import UNUSABLE_FEATURES
from objslam.io.detections_jsonl import read_detections, write_detections
from objslam.io.rays_parquet import RayFeatures, dump_features, read_features
from objslam.simulation import make_camera

BOX = [300.0, 200.0, 330.0, 240.0]


def lines(tmp_path: Path, *features: object) -> Path:
    """A file whose only frame has one box for each of the features."""
    count = len(features)
    frame = {"stamp": 1.0, "boxes": [BOX] * count, "labels": ["cup"] * count, "scores": [0.9] * count}
    file = tmp_path / "detections.jsonl"
    file.write_text(json.dumps(frame | {"features": features}) + "\n")
    return file


def test_vectors_are_scaled_and_boxes_without_one_stay(tmp_path: Path) -> None:
    ledger = Ledger()
    found = read_detections(lines(tmp_path, [3, 4], None, [0, -2.0]), ledger)
    assert not ledger.lines()
    assert found.features is not None
    np.testing.assert_allclose(found.features[[0, 2]], [[0.6, 0.8], [0.0, -1.0]], atol=1e-7)
    assert np.isnan(found.features[1]).all()


@pytest.mark.parametrize("wrong", [[1, 2, 3], [1], [], [0, 0], [float("nan"), 1], [float("inf"), 1]])
def test_a_vector_that_cannot_be_compared_is_counted_and_its_box_stays(tmp_path: Path, wrong: list[float]) -> None:
    ledger, file = Ledger(), lines(tmp_path, [3, 4], wrong, [4, 3])
    found = read_detections(file, ledger)
    assert len(found) == 3
    assert found.features is not None
    assert np.isnan(found.features).all(axis=1).tolist() == [False, True, False]
    assert ledger.dropped == {UNUSABLE_FEATURES: 1}
    assert ledger.examples[UNUSABLE_FEATURES] == [f"{file}:1"]


@pytest.mark.parametrize("wrong", [[[0, 0], [0, 0]], [[], []]])
def test_a_log_whose_vectors_are_all_wrong_has_none(tmp_path: Path, wrong: list[list[float]]) -> None:
    ledger = Ledger()
    assert read_detections(lines(tmp_path, *wrong), ledger).features is None
    assert ledger.dropped == {UNUSABLE_FEATURES: 2}


@pytest.mark.parametrize(
    ("features", "reason"),
    [
        ([[1, 2], [1, 2]], "boxes and features differ in length"),
        (["cup"], "features must hold numbers only"),
        ([[1, "2"]], "features must hold numbers only"),
        (3, "features is missing or not a list"),
    ],
)
def test_a_frame_with_malformed_features_is_dropped(tmp_path: Path, features: object, reason: str) -> None:
    file = tmp_path / "detections.jsonl"
    frame = {"stamp": 1.0, "boxes": [BOX], "labels": ["cup"], "scores": [0.9]}
    file.write_text("\n".join(json.dumps(one) for one in (frame, frame | {"stamp": 2.0, "features": features})))
    ledger = Ledger()
    assert read_detections(file, ledger).features is None
    assert ledger.dropped == {f"detection frame malformed: {reason}": 1}


def frames(features: list[object] | None) -> Detections:
    """Three frames with two boxes, none and one."""
    boxes = [[BOX, [10.0, 10.0, 40.0, 40.0]], [], [BOX]]
    return Detections.from_frames([1.0, 2.0, 3.0], boxes, [["cup", "cup"], [], ["cup"]], features=features)


def test_written_vectors_are_read_back_to_the_last_bit(tmp_path: Path) -> None:
    vectors = np.random.default_rng(0).normal(size=(2, 48))
    sent = frames([[vectors[0], np.full(48, np.nan)], [], [vectors[1]]])
    write_detections(sent, tmp_path / "detections.jsonl")
    found = read_detections(tmp_path / "detections.jsonl", Ledger())
    np.testing.assert_array_equal(found.features, sent.features, strict=True)
    write_detections(sent.take(np.array([1])), tmp_path / "detections.jsonl")
    assert "features" not in (tmp_path / "detections.jsonl").read_text()


@pytest.mark.parametrize(
    ("features", "reason"),
    [
        ([[[1, 2], [1, 2]], []], "one list for each frame, got 2 for 3"),
        ([[[1, 2], [1, 2]], [], [[1, 2, 3]]], r"frame 2: features are \(1, 2\)"),
        ([[[1, 2]], [], [[1, 2]]], r"frame 0: features are \(2, 2\)"),
        ([[[1, 2], [0, 0]], [], [[1, 2]]], "frame 0: features that are zero or not finite"),
        ([[[1, 2], [1, np.nan]], [], [[1, 2]]], "frame 0: features that are zero or not finite"),
    ],
)
def test_wrong_vectors_from_python_are_named(features: list[object], reason: str) -> None:
    with pytest.raises(ValueError, match=reason):
        frames(features)


def log_of(*cameras: Detections) -> Log:
    path = Trajectory(np.arange(5.0), np.tile(np.eye(4), (5, 1, 1)))
    views = tuple(CameraLog(make_camera(f"camera {i}"), found) for i, found in enumerate(cameras))
    return Log("log", views, localization=path)


def test_each_ray_knows_its_vector() -> None:
    first = frames([[[0, 2], [np.nan, np.nan]], [], [[5, 0]]])
    log, settings, ledger = log_of(first, frames(None), frames([[[1, 1], [1, -1]], [], [[-1, 0]]])), Settings(), Ledger()
    keyframes = build_keyframes(log, settings, ledger)
    rays = build_rays(log, keyframes, settings, ledger)
    assert rays.feature is not None
    assert rays.feature_table is not None
    found = {}
    for ray in range(len(rays)):
        camera, frame = keyframes.camera[rays.keyframe[ray]], keyframes.frame[rays.keyframe[ray]]
        row = rays.feature[ray]
        vector = None if row < 0 else rays.feature_table.vectors[row].astype(float).round(3).tolist()
        found[int(camera), int(frame), float(rays.box[ray, 0])] = vector
    assert {key: value for key, value in found.items() if key[0] == 0} == {
        (0, 0, 300.0): [0.0, 1.0],
        (0, 0, 10.0): None,
        (0, 2, 300.0): [1.0, 0.0],
    }
    assert {value is None for key, value in found.items() if key[0] == 1} == {True}
    assert found[2, 0, 10.0] == [0.707, -0.707]
    kept = rays.take(np.array([len(rays) - 1]))
    assert kept.feature is not None
    assert kept.feature_table is rays.feature_table


def test_vectors_of_another_length_than_those_of_the_first_camera_are_counted() -> None:
    log = log_of(frames([[[0, 2], [1, 1]], [], [[5, 0]]]), frames([[[1, 1, 1]] * 2, [], [[1, 0, 0]]]))
    ledger = Ledger()
    keyframes = build_keyframes(log, Settings(), ledger)
    rays = build_rays(log, keyframes, Settings(), ledger)
    assert rays.feature is not None
    assert (rays.feature[keyframes.camera[rays.keyframe] == 1] == -1).all()
    assert sum(count for reason, count in ledger.dropped.items() if "another length" in reason) == 3


def test_a_log_without_vectors_has_rays_without() -> None:
    log = log_of(frames(None))
    keyframes = build_keyframes(log, Settings(), Ledger())
    rays = build_rays(log, keyframes, Settings(), Ledger())
    assert rays.feature is None
    assert rays.feature_table is None


def test_vectors_that_are_not_of_length_one_are_refused() -> None:
    found = frames([[[0, 2], [1, 1]], [], [[5, 0]]])
    assert found.features is not None
    for wrong in (2 * found.features, found.features.astype(np.float64), found.features[:2]):
        with pytest.raises(ValueError, match="features"):
            replace(found, features=wrong)


def test_the_file_beside_the_rays_comes_back(tmp_path: Path) -> None:
    file, vectors = tmp_path / "features.parquet", np.eye(3, 5, dtype=np.float32)
    file.write_bytes(dump_features(RayFeatures(np.array([0, 4, 9]), vectors)))
    found = read_features(file)
    assert found.ray.tolist() == [0, 4, 9]
    np.testing.assert_array_equal(found.vectors, vectors, strict=True)


@pytest.mark.parametrize(
    "table",
    [
        {"ray": [0], "features": pa.array([[1.0, 1.0]], pa.list_(pa.float32(), 2))},
        {"ray": [0], "features": pa.array([[1.0, 0.0]], pa.list_(pa.float64(), 2))},
        {"ray": [1, 0], "features": pa.array([[1.0, 0.0]] * 2, pa.list_(pa.float32(), 2))},
        {"ray": [0], "features": [1.0]},
        {"ray": [0], "features": pa.array([None], pa.list_(pa.float32(), 2))},
        {"ray": [0]},
    ],
)
def test_a_file_that_no_run_writes_is_refused(tmp_path: Path, table: dict[str, object]) -> None:
    pq.write_table(pa.table(table), tmp_path / "features.parquet")
    with pytest.raises(OutputError, match="not what a run writes"):
        read_features(tmp_path / "features.parquet")
