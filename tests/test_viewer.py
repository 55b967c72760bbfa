"""recording.rrd, read back with rerun's own reader."""

from __future__ import annotations

import dataclasses
from collections import defaultdict
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pytest
from scipy.spatial.transform import Rotation
from synthetic_result import clusters, synthetic_result

from objslam.results import RunResult
from objslam.types import Truth
from objslam.viewer import write_recording


class Recording:
    """The columns of a recording by entity path and component."""

    def __init__(self, file: Path) -> None:
        from rerun.chunk import RrdReader

        self.columns: dict[tuple[str, str], list[pa.Array]] = defaultdict(list)
        self.stamps: dict[str, pa.Array] = {}
        self.static: dict[str, set[bool]] = defaultdict(set)
        for chunk in RrdReader(file).stream().to_chunks():
            batch = chunk.to_record_batch()
            self.static[chunk.entity_path].add(chunk.is_static)
            for field, column in zip(batch.schema, batch.columns, strict=True):
                self.columns[chunk.entity_path, field.name].append(column)
                if field.name == "stamp":
                    self.stamps[chunk.entity_path] = column

    def get(self, path: str, component: str) -> list[Any]:
        (column,) = self.columns[path, component]
        values: list[Any] = column.to_pylist()
        return values

    def paths(self) -> set[str]:
        return {path for path, _ in self.columns if path.startswith(("/map", "/log"))}


@pytest.fixture
def record(tmp_path: Path) -> Any:
    def write(result: RunResult, truth: Truth | None = None) -> Recording:
        write_recording(result, tmp_path / "a.rrd", truth)
        return Recording(tmp_path / "a.rrd")

    return write


def test_the_whole_story_is_in_the_recording(record: Any) -> None:
    positions, labels = clusters()
    result, truth = synthetic_result(positions, labels, keyframes=30, unresolved=(4,))
    r = record(result, truth)
    assert r.paths() == {
        "/map", "/map/path/before", "/map/path/after", "/map/path/truth", "/map/objects", "/map/objects/uncertainty",
        "/map/objects/labels", "/map/objects/unresolved", "/map/truth", "/map/base", "/map/rays/used", "/map/rays/rejected",
        "/map/rays/unexplained", "/map/rays/now", "/log",
    }  # fmt: skip
    assert r.static["/map/objects"] == r.static["/map/path/after"] == r.static["/map/rays/used"] == {True}
    assert r.get("/map", "ViewCoordinates:xyz") == [[[3, 5, 1]]]  # right, forward, up: z up

    resolved = result.map.resolved()
    np.testing.assert_allclose(r.get("/map/objects", "Points3D:positions")[0], [o.position for o in resolved], rtol=1e-6)
    assert r.get("/map/objects", "Points3D:labels")[0] == [o.label for o in resolved]
    assert r.get("/map/objects/labels", "Points3D:labels")[0][4] == f"{labels[4]}, unresolved"
    np.testing.assert_allclose(r.get("/map/truth", "Points3D:positions")[0], positions, rtol=1e-6)
    assert r.get("/map/truth", "Points3D:colors") == [[0x000000FF]]
    for name, poses in (("before", result.path.poses), ("after", result.map_T_base), ("truth", truth.trajectory.poses)):
        (strip,) = r.get(f"/map/path/{name}", "LineStrips3D:strips")[0]
        np.testing.assert_allclose(strip, poses[:, :3, 3], rtol=1e-5, atol=1e-6)
    (unresolved,) = r.get("/map/objects/unresolved", "LineStrips3D:strips")[0]
    np.testing.assert_allclose(unresolved[1], result.map.objects[4].position, rtol=1e-6)


def test_the_ellipsoids_are_the_covariances(record: Any) -> None:
    result, _ = synthetic_result(*clusters(), keyframes=5)
    r = record(result)
    half = np.array(r.get("/map/objects/uncertainty", "Ellipsoids3D:half_sizes")[0])
    turn = Rotation.from_quat(r.get("/map/objects/uncertainty", "Ellipsoids3D:quaternions")[0]).as_matrix()
    covariance = np.einsum("nij,nj,nkj->nik", turn, (half / 2) ** 2, turn)
    np.testing.assert_allclose(covariance, [o.covariance for o in result.map.objects], rtol=1e-4, atol=1e-9)
    np.testing.assert_allclose(
        r.get("/map/objects/uncertainty", "Ellipsoids3D:centers")[0], [o.position for o in result.map.objects], rtol=1e-6
    )


def test_each_moment_has_its_rays_and_no_other(record: Any) -> None:
    result, _ = synthetic_result(*clusters(), keyframes=20)
    result = drop_rays(result, result.rays.keyframe != 7)
    r = record(result)
    strips = r.get("/map/rays/now", "LineStrips3D:strips")
    colours = r.get("/map/rays/now", "LineStrips3D:colors")
    counts = np.bincount(result.rays.keyframe, minlength=20)
    assert [len(row) for row in strips if row is not None] == counts.tolist()
    assert counts[7] == 0
    np.testing.assert_allclose(np.array([s[0] for row in strips if row for s in row]), result.origins, rtol=1e-5, atol=1e-6)
    # blue, red, grey: which channel leads
    for colour, held, weight in zip(
        [c for row in colours if row for c in row], result.association.object >= 0, result.weight, strict=True
    ):
        red, green, blue = colour >> 24, colour >> 16 & 255, colour >> 8 & 255
        assert (red == green == blue) if not held else (blue > red) if weight >= 0.5 else (red > blue)
    assert len(r.get("/map/base", "Transform3D:translation")) == 20
    np.testing.assert_allclose(
        np.array([row[0] for row in r.get("/map/base", "Transform3D:translation")]), result.map_T_base[:, :3, 3], atol=1e-5
    )


def test_two_cameras_at_one_stamp_show_their_rays_together(record: Any) -> None:
    result, _ = synthetic_result(*clusters(), keyframes=10)
    stamps = result.keyframes.stamps.copy()
    stamps[5] = stamps[4]
    r = record(dataclasses.replace(result, keyframes=dataclasses.replace(result.keyframes, stamps=stamps)))
    strips = r.get("/map/rays/now", "LineStrips3D:strips")
    assert [len(row) for row in strips if row is not None] == [15] * 4 + [30] + [15] * 4


@pytest.mark.parametrize(("start", "kind"), [(100.0, pa.types.is_duration), (1.3e9, pa.types.is_timestamp)])
def test_unix_stamps_are_dates_others_durations(record: Any, start: float, kind: Any) -> None:
    result, _ = synthetic_result(*clusters(), keyframes=5, start=start)
    stamps = record(result).stamps["/map/base"]
    assert kind(stamps.type)
    np.testing.assert_allclose(np.asarray(stamps.cast(pa.int64())) * 1e-9, result.keyframes.stamps, rtol=0, atol=1e-6)


def test_warnings_are_text(record: Any) -> None:
    result, _ = synthetic_result(*clusters(), keyframes=5, unresolved=(1,))
    r = record(result)
    assert [row[0] for row in r.get("/log", "TextLog:text")] == [
        "14 objects, 1 unresolved, 75 rays, 5 keyframes",
        "the clock of the camera runs 0.04 s late",
    ]
    assert [row[0] for row in r.get("/log", "TextLog:level")] == ["INFO", "WARN"]


def test_a_long_run_makes_a_small_file(record: Any, tmp_path: Path) -> None:
    result, truth = synthetic_result(*clusters(), keyframes=2000)
    r = record(result, truth)
    assert (tmp_path / "a.rrd").stat().st_size < 40 * len(result.rays) + 100 * len(result.keyframes) + 200_000
    assert len(r.get("/map/rays/used", "LineStrips3D:strips")[0]) == 400


@pytest.mark.parametrize("count", [0, 1])
def test_next_to_nothing_can_be_recorded(record: Any, count: int) -> None:
    result, _ = synthetic_result(np.ones((count, 3)), ["cup"] * count, keyframes=2, unresolved=(0,))
    assert ("/map/objects/unresolved" in record(result).paths()) == bool(count)
    lost = [dataclasses.replace(o, position=np.full(3, np.nan)) for o in result.map.objects]
    record(dataclasses.replace(result, map=dataclasses.replace(result.map, objects=tuple(lost))))


def test_a_recording_that_cannot_be_written_is_an_error(tmp_path: Path) -> None:
    result, _ = synthetic_result(*clusters(), keyframes=2)
    with pytest.raises(OSError, match="No such file"):
        write_recording(result, tmp_path / "none" / "a.rrd")


def drop_rays(result: RunResult, keep: np.ndarray) -> RunResult:
    """The result with a selection of its rays."""
    arrays = {name: getattr(result, name)[keep] for name in ("origins", "directions", "residual", "weight")}
    association = dataclasses.replace(result.association, object=result.association.object[keep])
    return dataclasses.replace(result, rays=result.rays.take(keep), association=association, **arrays)
