"""The appearance of objects in a result: the best view of each, and the search for what looks alike."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

import objslam
from objslam.core.object_map import MapObject, ObjectMap
from objslam.io.rays_parquet import read_features
from objslam.simulation import AppearanceNoise, DriveSettings, simulate

QUIET = {"output": {"picture": False, "recording": False}}


@pytest.fixture(scope="module")
def drive() -> objslam.Log:
    settings = {"objects": 5, "classes": 2, "frames": 200, "pixel_sigma": 1.0, "tracks": "perfect"}
    log = simulate(DriveSettings(**settings, appearance=AppearanceNoise(confusion=0.02, numbers=16)), 3)
    return objslam.Log(**vars(log))


@pytest.fixture(scope="module")
def result(drive: objslam.Log) -> objslam.Result:
    return objslam.run(drive, QUIET, mode="fixed")


def test_each_object_has_the_vector_of_its_largest_box(drive: objslam.Log, result: objslam.Result) -> None:
    detections = drive.cameras[0].detections
    assert detections is not None
    assert detections.features is not None
    assert drive.truth is not None
    area = (detections.boxes[:, 2:] - detections.boxes[:, :2]).prod(axis=1)
    for one in result.objects:
        true = min(drive.truth.objects, key=lambda o: float(np.linalg.norm(o.position - one.position)))
        inside = (detections.boxes[:, :2] > 2).all(axis=1) & (detections.boxes[:, 2:] < [637, 477]).all(axis=1)
        mine = np.flatnonzero((detections.track_ids == true.id) & inside)
        # Boxes near the image's edge are no rays, so the largest ray may be smaller than the largest box.
        order = mine[np.argsort(-area[mine])]
        same = [i for i in order if np.array_equal(detections.features[i], one.features)]
        assert len(same) == 1
        used = result.rays.box[result.rays.object == one.id]
        assert area[same[0]] == pytest.approx(float((used[:, 2:] - used[:, :2]).prod(axis=1).max()))


def test_the_search_ranks_by_the_cosine_also_after_a_load(result: objslam.Result, tmp_path: Path) -> None:
    result.save(tmp_path / "out")
    objects = objslam.ObjectMap.load(tmp_path / "out")
    for one, read in zip(result.objects, objects, strict=True):
        np.testing.assert_array_equal(read.features, one.features, strict=True)
    query = np.random.default_rng(0).normal(size=16)
    cosine = {o.id: float(o.features @ query / np.linalg.norm(query)) for o in objects if o.features is not None}
    found = objects.search(query, 3)
    assert [o.id for o, _ in found] == sorted(cosine, key=lambda i: -cosine[i])[:3]
    np.testing.assert_allclose([c for _, c in found], [cosine[o.id] for o, _ in found], atol=1e-6)
    best = objects[0].features
    assert best is not None
    assert objects.search(7 * best, 1)[0][0].id == objects[0].id


def test_the_vectors_of_all_rays_lie_beside_them(drive: objslam.Log, result: objslam.Result, tmp_path: Path) -> None:
    detections = drive.cameras[0].detections
    assert detections is not None
    assert detections.features is not None
    result.save(tmp_path / "out")
    found = read_features(tmp_path / "out" / "features.parquet")
    assert found.ray.tolist() == list(range(len(result.rays)))
    row = {tuple(box): i for i, box in enumerate(detections.boxes.tolist())}
    of_rays = [row[tuple(box)] for box in result.rays.box.tolist()]
    np.testing.assert_array_equal(found.vectors, detections.features[of_rays])


def test_a_log_without_vectors_has_a_result_without(drive: objslam.Log, result: objslam.Result, tmp_path: Path) -> None:
    detections = drive.cameras[0].detections
    assert detections is not None
    bare = objslam.run(drive.with_detections(replace(detections, features=None)), QUIET, mode="fixed")
    assert all(o.features is None for o in bare.objects)
    assert bare.objects.search(np.ones(16)) == ()
    result.save(tmp_path / "out")
    assert "features.parquet" in bare.save(tmp_path / "out")
    assert not (tmp_path / "out" / "features.parquet").exists()


@pytest.mark.parametrize("rays", [[0.5, 1.0], [float("nan"), 1.0], [None, 1]])
def test_vectors_of_rays_without_a_whole_number_are_refused(tmp_path: Path, rays: list[float | None]) -> None:
    vectors = pa.FixedSizeListArray.from_arrays(pa.array(np.eye(2, dtype=np.float32).ravel()), 2)
    pq.write_table(pa.table({"ray": rays, "features": vectors}), tmp_path / "features.parquet")
    with pytest.raises(objslam.ObjslamError, match="not whole numbers"):
        read_features(tmp_path / "features.parquet")


def test_vectors_of_another_length_are_named_or_left_out() -> None:
    thing = MapObject(0, "cup", np.zeros(3), np.eye(3), "ok", 1, 1, 0.0, 0.0, 0.0, 0.0)
    vectors = (np.eye(2, dtype=np.float32)[0], np.eye(3, dtype=np.float32)[0], None)
    objects = ObjectMap(tuple(replace(thing, id=i, features=vector) for i, vector in enumerate(vectors)))
    assert [o.id for o, _ in objects.search([1.0, 0.0])] == [0]
    assert [o.id for o, _ in objects.search([1.0, 0.0, 0.0])] == [1]
    with pytest.raises(ValueError, match="the vector has 4 numbers, but the vectors of the objects have 2"):
        objects.search(np.ones(4))


def test_a_merge_keeps_the_vector_of_the_map_that_has_one() -> None:
    bare = ObjectMap((MapObject(0, "cup", np.zeros(3), np.eye(3), "ok", 1, 1, 0.0, 0.0, 0.0, 0.0),))
    seen = replace(bare, objects=(replace(bare[0], features=np.eye(2, dtype=np.float32)[1]),))
    for one, other in ((bare, seen), (seen, bare), (seen, seen)):
        (merged,) = one.merge(other)
        np.testing.assert_array_equal(merged.features, seen[0].features)
