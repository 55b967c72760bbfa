"""The result folder: what is written, what is read back, and what a kill or a full disk leaves behind."""

from __future__ import annotations

import contextlib
import dataclasses
import fcntl
import json
import math
import os
import re
import resource
import shutil
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
from faults import contents, in_child, killed_at
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from small_log import small_log
from synthetic_result import clusters, synthetic_result

from objslam.config import Output, Settings, load_settings
from objslam.core.object_map import MapObject, ObjectMap
from objslam.core.result import RunResult
from objslam.core.types import Association, Truth
from objslam.errors import LogError, OutputError
from objslam.io.objects_json import dump_objects, dump_truth_objects, read_objects, read_truth_objects
from objslam.io.results.read import load_map, load_rays, load_trajectory, load_truth
from objslam.io.tum_trajectory import write_trajectory
from objslam.output.result_folder import prepare_output, write_result
from objslam.simulation import make_camera
from objslam.sources.log_folder import write_log_folder

PLAIN = Settings(output=Output(recording=False, picture=False))
PLAIN_FILES = {"objects.json", "trajectory.txt", "path.txt", "rays.parquet", "config.yaml", "doubts.json", "summary.json"}


def small(seed: int = 0, settings: Settings = PLAIN, keyframes: int = 12) -> RunResult:
    positions, labels = clusters()
    return synthetic_result(positions[:4], labels[:4], keyframes=keyframes, seed=seed, unresolved=(2,), settings=settings)[0]


def strict_json(file: Path) -> object:
    def refuse(name: str) -> None:
        raise AssertionError(f"{name} is no JSON")

    return json.loads(file.read_text(encoding="utf-8"), parse_constant=refuse)


def same_object(a: MapObject, b: MapObject) -> bool:
    def flat(o: MapObject) -> list[object]:
        values: list[object] = []
        for field in dataclasses.fields(o):
            value = getattr(o, field.name)
            for part in value if isinstance(value, tuple) else (value,):
                values.append(part.tolist() if isinstance(part, np.ndarray) else part)
        return values

    return repr(flat(a)) == repr(flat(b))  # repr: NaN equals NaN, -0.0 differs from 0.0


finite = st.floats(allow_nan=False, allow_infinity=False)
texts = st.text(st.characters(exclude_categories=("Cs",)), min_size=1, max_size=12)
vectors = hnp.arrays(np.float64, 3, elements=st.floats(-9.9e6, 9.9e6))
directions = st.sampled_from([np.array([0.6, 0.0, -0.8]), np.array([0.0, -0.0, 1.0])])
covariances = hnp.arrays(np.float64, (3, 3), elements=st.floats(-1e3, 1e3)).map(lambda root: root @ root.T)
maybe = finite | st.just(math.nan)
stamps = st.floats(-1e20, 1e20) | st.just(math.nan)
sides = st.floats(0.0, 9.9e6)


@st.composite
def map_objects(draw: st.DrawFn, number: int) -> MapObject:
    status = draw(st.sampled_from(["ok", "unresolved"]))
    return MapObject(
        id=number,
        label=draw(texts),
        position=draw(vectors),
        covariance=draw(st.none() | covariances),
        status=status,
        rays=draw(st.integers(0, 10**9)),
        frames=draw(st.integers(0, 10**9)),
        parallax_deg=draw(maybe),
        rms_deg=draw(maybe),
        first_seen=draw(stamps),
        last_seen=draw(stamps),
        extent=draw(st.none() | st.tuples(sides, sides)),
        ray=draw(st.none() | st.tuples(vectors, directions)) if status == "unresolved" else None,
    )


maps = st.integers(0, 4).flatmap(
    lambda n: st.tuples(*(map_objects(3 * i - 2) for i in range(n))).flatmap(lambda o: texts.map(lambda f: ObjectMap(o, f)))
)


@given(maps)
def test_objects_file_is_lossless(tmp_path_factory: pytest.TempPathFactory, objects: ObjectMap) -> None:
    file = tmp_path_factory.getbasetemp() / "round.json"
    file.write_text(dump_objects(objects), encoding="utf-8")
    strict_json(file)
    back = read_objects(file)
    assert back.frame == objects.frame
    assert len(back) == len(objects)
    assert all(same_object(a, b) for a, b in zip(back.objects, objects.objects, strict=True))


def test_what_is_not_finite_becomes_null(tmp_path: Path) -> None:
    o = small().map.objects[2]
    odd = dataclasses.replace(
        o, position=np.array([1.0, np.nan, np.inf]), covariance=np.full((3, 3), np.inf), rms_deg=np.nan
    )
    file = tmp_path / "objects.json"
    file.write_text(dump_objects(ObjectMap((odd,))), encoding="utf-8")
    entry = strict_json(file)["objects"][0]  # type: ignore[index]
    assert entry["position"] == [1.0, None, None]
    assert entry["covariance"] is None
    assert entry["rms_deg"] is None
    np.testing.assert_array_equal(read_objects(file).objects[0].position, [1.0, np.nan, np.nan])


GOOD = {
    "id": 0, "label": "cup", "position": [1, 2.0, 3], "covariance": None, "status": "ok", "rays": 3, "frames": 3,
    "parallax_deg": 9.0, "rms_deg": 0.1, "extent": None, "first_seen": 0.0, "last_seen": 1.0,
}  # fmt: skip


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"id": True}, "objects[1]: id must be an integer, got True"),
        ({"id": 0}, "objects[1]: id 0 occurs twice"),
        ({"id": 2**63}, "id must be an integer"),
        ({"label": ""}, "label must be text"),
        ({"label": "\ud800"}, "label must be text"),
        ({"position": [1, 2]}, "position must be 3 numbers, got [1, 2]"),
        ({"position": [1, 2, None]}, "position must be a finite number, got nothing"),
        ({"position": [1, 2, 10**400]}, "position must be a finite number"),
        ({"position": [1, 2, "3"]}, "position must be a finite number, got '3'"),
        ({"covariance": [[1, 2, 3]]}, "covariance must be 3 rows of 3 numbers"),
        ({"covariance": [[1, 2, 3], [1, 2], [1, 2, 3]]}, "a row of covariance must be 3 numbers"),
        ({"status": "fine"}, "status must be"),
        ({"rays": 1.5}, "rays must be an integer, got 1.5"),
        ({"extent": [1]}, "extent must be 2 numbers"),
        ({"ray": [1]}, "ray must have an origin and a direction"),
        ({"ray": {"origin": [1, 2, 3]}}, "ray.direction must be 3 numbers, got nothing"),
    ],
)
def test_malformed_objects_are_named(tmp_path: Path, change: dict[str, object], message: str) -> None:
    file = tmp_path / "objects.json"
    file.write_text(json.dumps({"format": "objslam.objects/1", "objects": [GOOD, GOOD | {"id": 1} | change]}))
    with pytest.raises(OutputError) as caught:
        load_map(tmp_path)
    assert caught.value.where == str(file)
    assert message in caught.value.message
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "not JSON"),
        (b'{"objects": [\n{"id": 1,}]}', "line 2"),
        (b"\xff\xfe", "not UTF-8 text"),
        (b"[]", "not an objects file"),
        (b'{"objects": {}}', "not an objects file"),
        (b'{"format": "objslam.objects/1", "objects": [3]}', "objects[0]: not a mapping"),
        (b'{"objects": []}', "format is None"),
        (b'{"format": "objslam.objects/3", "objects": []}', "format is 'objslam.objects/3'"),
        (b"[" * 100_000, "not JSON that can be read"),
        (b'{"format": "objslam.objects/1", "objects": [{"id": ' + b"9" * 10_000 + b"}]}", "not JSON that can be read"),
    ],
)
def test_files_that_are_no_objects_file(tmp_path: Path, content: bytes, message: str) -> None:
    (tmp_path / "objects.json").write_bytes(content)
    with pytest.raises(OutputError) as caught:
        load_map(tmp_path)
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


@given(st.binary(max_size=60) | st.recursive(st.none() | st.booleans() | finite | st.text(), lambda x: st.lists(x) | st.dictionaries(st.sampled_from([*GOOD, "objects", "format"]), x)).map(lambda x: json.dumps({"format": "objslam.objects/1", "objects": [x]}).encode()))  # fmt: skip  # noqa: E501
def test_no_content_breaks_the_reader(tmp_path_factory: pytest.TempPathFactory, content: bytes) -> None:
    file = tmp_path_factory.getbasetemp() / "any.json"
    file.write_bytes(content)
    for read, error in ((read_objects, OutputError), (read_truth_objects, LogError)):
        with contextlib.suppress(error):
            read(file)


def test_truth_needs_id_label_position_only(tmp_path: Path) -> None:
    file = tmp_path / "objects.json"
    file.write_text(
        '\ufeff{"objects": [{"id": 7, "label": "cup", "position": [1, 2, 3], "colour": "red"}]}', encoding="utf-8"
    )
    (truth,) = read_truth_objects(file)
    assert (truth.id, truth.label, truth.position.tolist()) == (7, "cup", [1.0, 2.0, 3.0])


def test_the_map_of_another_run_is_a_truth_without_its_unresolved_objects(tmp_path: Path) -> None:
    result = small()
    file = tmp_path / "objects.json"
    file.write_text(dump_objects(result.map), encoding="utf-8")
    assert [o.id for o in read_truth_objects(file)] == [o.id for o in result.map.resolved()]
    with pytest.raises(OutputError, match="cannot read"):
        read_truth_objects(tmp_path / "none.json", OutputError)


def test_a_result_holds_what_was_estimated(tmp_path: Path) -> None:
    result = small()
    summary: dict[str, object] = {
        "mode": "joint",
        "cost": np.float64(2.5),
        "bad": [math.nan, np.inf],
        "n": np.int64(3),
        "v": np.ones(2),
    }
    result = dataclasses.replace(result, summary=summary)
    write_result(result, tmp_path)

    assert {p.name for p in tmp_path.iterdir()} == PLAIN_FILES
    assert all(same_object(a, b) for a, b in zip(load_map(tmp_path).objects, result.map.objects, strict=True))
    assert strict_json(tmp_path / "summary.json") == {
        "mode": "joint",
        "cost": 2.5,
        "bad": [None, None],
        "n": 3,
        "v": [1.0, 1.0],
    }
    assert load_settings(tmp_path / "config.yaml") == result.settings
    path = load_trajectory(tmp_path)
    np.testing.assert_array_equal(path.stamps, result.keyframes.stamps)
    np.testing.assert_allclose(path.poses, result.map_T_base, atol=1e-12)

    rays = pq.read_table(tmp_path / "rays.parquet").to_pydict()
    ids = [o.id for o in result.map.objects]
    assert rays["object"] == [None if i < 0 else ids[i] for i in result.association.object]
    assert rays["residual"] == [None if math.isnan(x) else x for x in result.residual]
    np.testing.assert_array_equal(load_rays(tmp_path).residual, result.residual)  # rad, in the file and read back
    assert rays["stamp"] == result.keyframes.stamps[result.rays.keyframe].tolist()
    assert rays["label"] == [result.rays.label_names[i] for i in result.rays.label]
    np.testing.assert_array_equal(rays["origin"], result.origins)
    np.testing.assert_array_equal(rays["direction"], result.directions)
    np.testing.assert_array_equal(rays["weight"], result.weight)
    np.testing.assert_array_equal(rays["box"], result.rays.box)
    np.testing.assert_array_equal(rays["score"], result.rays.score)
    assert rays["camera"] == ["front"] * len(result.rays)
    unresolved = strict_json(tmp_path / "objects.json")["objects"][2]  # type: ignore[index]
    assert set(unresolved["ray"]) == {"origin", "direction"}


def test_the_truth_is_kept_beside_the_result(tmp_path: Path) -> None:
    result, truth = synthetic_result(*clusters(), keyframes=5, settings=PLAIN)
    out = tmp_path / "out"
    write_result(result, out, truth)
    same_truth(load_truth(out), truth)
    write_result(result, out, dataclasses.replace(truth, objects=()))
    same_truth(load_truth(out), dataclasses.replace(truth, objects=()))
    write_result(result, out)
    assert load_truth(out) is None  # its own objects.json and trajectory.txt are no truth
    assert {p.name for p in out.iterdir()} == PLAIN_FILES


def test_a_truth_is_found_in_a_file_a_log_and_a_groundtruth_folder(tmp_path: Path) -> None:
    _, truth = synthetic_result(*clusters(), keyframes=5)
    inner = tmp_path / "log" / "groundtruth"
    inner.mkdir(parents=True)
    assert load_truth(inner) is None
    assert load_truth(inner.parent) is None
    (inner / "objects.json").write_text(dump_truth_objects(truth.objects))
    same_truth(load_truth(inner / "objects.json"), dataclasses.replace(truth, trajectory=None))
    write_trajectory(truth.trajectory, inner / "trajectory.txt")
    same_truth(load_truth(inner), truth)
    same_truth(load_truth(tmp_path / "log"), truth)
    with pytest.raises(LogError, match="no such ground truth"):
        load_truth(tmp_path / "none")
    (inner / "objects.json").write_text("{}")
    with pytest.raises(LogError, match="not an objects file"):
        load_truth(tmp_path / "log")


def same_truth(found: Truth | None, truth: Truth) -> None:
    assert found is not None
    assert [(o.id, o.label, o.position.tolist()) for o in found.objects] == [
        (o.id, o.label, o.position.tolist()) for o in truth.objects
    ]
    assert (found.trajectory is None) == (truth.trajectory is None)
    if found.trajectory is not None and truth.trajectory is not None:
        np.testing.assert_array_equal(found.trajectory.stamps, truth.trajectory.stamps)
        np.testing.assert_allclose(found.trajectory.poses, truth.trajectory.poses, atol=1e-12)


def test_cameras_that_share_a_stamp_give_one_pose_of_the_path(tmp_path: Path) -> None:
    result = small()
    stamps = result.keyframes.stamps.copy()
    stamps[5] = stamps[4]
    write_result(dataclasses.replace(result, keyframes=dataclasses.replace(result.keyframes, stamps=stamps)), tmp_path)
    path = load_trajectory(tmp_path)
    np.testing.assert_array_equal(path.stamps, np.unique(stamps))
    np.testing.assert_allclose(path.poses, result.map_T_base[[0, 1, 2, 3, 4, 6, 7, 8, 9, 10, 11]], atol=1e-12)


def test_a_result_without_objects_can_be_written(tmp_path: Path) -> None:
    result = synthetic_result(np.zeros((0, 3)), [], keyframes=3)[0]
    assert result.settings.output.recording
    write_result(result, tmp_path)
    assert len(load_map(tmp_path)) == 0
    assert pq.read_table(tmp_path / "rays.parquet")["object"].null_count == len(result.rays)


def test_an_older_result_goes_as_a_whole_and_foreign_files_stay(tmp_path: Path) -> None:
    first = small(settings=Settings())
    write_result(first, tmp_path)
    assert {p.name for p in tmp_path.iterdir()} == PLAIN_FILES | {"map.png", "recording.rrd"}
    (tmp_path / "evaluation.json").write_text("{}")
    (tmp_path / "notes.txt").write_text("mine")
    removed = write_result(small(seed=1), tmp_path)
    assert set(removed) == {"map.png", "recording.rrd", "evaluation.json"}
    assert {p.name for p in tmp_path.iterdir()} == PLAIN_FILES | {"notes.txt"}
    assert (tmp_path / "notes.txt").read_text() == "mine"


@pytest.mark.forks
def test_killed_at_any_moment_no_half_file_and_no_mix(tmp_path: Path) -> None:
    old, new = small(seed=0), dataclasses.replace(small(seed=1, keyframes=13), summary={"mode": "fixed"})
    write_result(old, tmp_path / "old")
    write_result(new, tmp_path / "new")
    was, will_be = contents(tmp_path / "old"), contents(tmp_path / "new")
    assert all(was[name] != will_be[name] for name in ("summary.json", "objects.json", "trajectory.txt", "rays.parquet"))

    seen = set()
    for step in range(200):
        out = Path(shutil.copytree(tmp_path / "old", tmp_path / f"out{step}"))
        code = in_child(killed_at(step, lambda out=out: write_result(new, out)))  # type: ignore[misc]
        found = contents(out)
        from_old = all(was.get(name) == data for name, data in found.items())
        from_new = all(will_be.get(name) == data for name, data in found.items())
        assert from_old or from_new, f"a mix or a half file after step {step}: {sorted(found)}"
        if "summary.json" in found:
            assert found in (was, will_be), f"an incomplete result claims to be whole after step {step}"
        seen.add("old" if found == was else "new" if found == will_be else "none")
        prepare_output(out)  # what the kill left is no obstacle
        write_result(new, out)
        assert {p.name for p in out.iterdir()} == PLAIN_FILES
        if code == 0:
            break
        assert code == -9
    assert code == 0
    assert step > 15
    assert seen == {"old", "none", "new"}


@pytest.mark.parametrize(
    ("settings", "size"),
    [(PLAIN, 3), (PLAIN, 100), (PLAIN, 3000), (Settings(), 20_000), (Settings(output=Output(picture=False)), 20_000)],
    ids=["probe", "first file", "a later file", "picture", "recording"],
)
def test_a_full_disk_is_an_error_and_leaves_the_old_result(tmp_path: Path, settings: Settings, size: int) -> None:
    write_result(small(), tmp_path)
    before = contents(tmp_path)

    def work() -> None:
        resource.setrlimit(resource.RLIMIT_FSIZE, (size, size))
        write_result(small(seed=1, settings=settings), tmp_path)

    assert in_child(work) == 3
    assert contents(tmp_path) == before
    assert not (tmp_path / ".objslam-staging").exists()


def test_places_where_no_result_can_go(tmp_path: Path) -> None:
    file = tmp_path / "file"
    file.write_text("")
    with pytest.raises(OutputError, match="the output is a file, not a folder"):
        prepare_output(file)
    with pytest.raises(OutputError, match="Not a directory"):
        prepare_output(file / "out")
    with pytest.raises(OutputError, match="cannot write or read"):
        prepare_output(Path("/proc/objslam/out"))
    (tmp_path / "out" / "objects.json").mkdir(parents=True)
    with pytest.raises(OutputError, match="because a folder has its name"):
        prepare_output(tmp_path / "out")


def test_a_folder_in_the_way_of_any_file_leaves_the_old_result(tmp_path: Path) -> None:
    write_result(small(), tmp_path)
    (tmp_path / "front.detections.jsonl").mkdir()
    before = contents(tmp_path)
    with pytest.raises(OutputError, match="because a folder has its name"):
        write_result(small(seed=1), tmp_path)
    assert contents(tmp_path) == before


@pytest.mark.parametrize("inner", [".", "groundtruth", "cameras/left"])
def test_a_result_does_not_go_into_a_log(tmp_path: Path, inner: str) -> None:
    log = small_log(cameras=tuple(make_camera(name) for name in (("left", "right") if "left" in inner else ("left",))))
    write_log_folder(dataclasses.replace(log, truth=Truth(log.truth.objects) if log.truth else None), tmp_path / "log")
    out = tmp_path / "log" / inner
    before = {p: p.read_bytes() for p in (tmp_path / "log").rglob("*") if p.is_file()}
    assert any(p.name in ("detections.jsonl", "objects.json") for p in out.iterdir())
    for write in (lambda: prepare_output(out), lambda: write_result(small(), out)):
        with pytest.raises(OutputError, match=r"this is a log|not written by a run: objects\.json"):
            write()
    assert {p: p.read_bytes() for p in (tmp_path / "log").rglob("*") if p.is_file()} == before


@pytest.mark.parametrize("name", ["config.yaml", "summary.json", "objects.json", "front.detections.jsonl", "report.html"])
def test_a_file_that_no_run_wrote_stays(tmp_path: Path, name: str) -> None:
    (tmp_path / name).write_text('{"mine": true}')
    (tmp_path / "notes.txt").write_text("mine")
    for write in (lambda: prepare_output(tmp_path), lambda: write_result(small(), tmp_path)):
        with pytest.raises(OutputError, match=f"not written by a run: {re.escape(name)}") as caught:
            write()
        assert "\n" not in str(caught.value)
    assert contents(tmp_path) == {name: b'{"mine": true}', "notes.txt": b"mine"}


def test_what_a_killed_run_left_beside_is_still_not_taken_for_a_result(tmp_path: Path) -> None:
    assert in_child(killed_at(4, lambda: write_result(small(), tmp_path))) == -9
    assert (tmp_path / ".objslam-staging").is_dir()
    (tmp_path / "config.yaml").write_text("mode: joint")
    with pytest.raises(OutputError, match=r"config\.yaml"):
        prepare_output(tmp_path)


def test_the_objects_of_a_live_session_may_be_replaced(tmp_path: Path) -> None:
    (tmp_path / "objects.json").write_text(dump_objects(small().map))
    prepare_output(tmp_path)
    write_result(small(), tmp_path)
    assert {p.name for p in tmp_path.iterdir()} == PLAIN_FILES


def test_prepare_leaves_only_the_folder(tmp_path: Path) -> None:
    out = tmp_path / "a" / "b"
    prepare_output(out)
    assert list(out.iterdir()) == []
    prepare_output(out)


def test_two_runs_do_not_write_into_one_folder(tmp_path: Path) -> None:
    handle = os.open(tmp_path, os.O_RDONLY)
    fcntl.flock(handle, fcntl.LOCK_EX)
    with pytest.raises(OutputError, match="another run is writing here"):
        write_result(small(), tmp_path)
    os.close(handle)
    write_result(small(), tmp_path)


def test_half_a_surrogate_pair_is_one_line(tmp_path: Path) -> None:
    result = small()
    rays = dataclasses.replace(result.rays, label_names=("\ud800", *result.rays.label_names[1:]))
    with pytest.raises(OutputError, match="surrogate"):
        write_result(dataclasses.replace(result, rays=rays), tmp_path)
    summary = dataclasses.replace(result, summary={"warnings": ["\udfff"]})
    with pytest.raises(OutputError, match="surrogate"):
        write_result(summary, tmp_path)
    assert list(tmp_path.iterdir()) == []


def test_loading_what_is_not_there(tmp_path: Path) -> None:
    with pytest.raises(OutputError, match="there is no such result folder"):
        load_map(tmp_path / "none")
    with pytest.raises(OutputError, match=r"no result here: trajectory.txt is missing"):
        load_trajectory(tmp_path)
    (tmp_path / ".objslam-staging").mkdir()
    with pytest.raises(OutputError, match="run it again"):
        load_map(tmp_path)


@pytest.mark.parametrize(
    ("text", "where"),
    [
        ("0 0 0 0 0 0 0 1\n1 0 0 0 0 0 1\n", ":2"),
        ("0 0 0 0 0 0 0 1\n1 0 0 0 0 0 nan 1\n", ":2"),
        ("0 0 0 0 0 0 0 0\n1 0 0 0 0 0 0 1\n", ":1"),
        ("1 0 0 0 0 0 0 1\n\n# back\n1 0 0 0 0 0 0 1\n", ":4"),
        ("# nothing\n", ""),
        ("zero\n", ""),
    ],
)
def test_a_damaged_trajectory_names_its_line(tmp_path: Path, text: str, where: str) -> None:
    file = tmp_path / "trajectory.txt"
    file.write_text(text)
    with pytest.raises(OutputError) as caught:
        load_trajectory(tmp_path)
    assert f"{file}{where}" in str(caught.value)
    assert "\n" not in str(caught.value)


def test_rays_of_no_object_have_no_id_even_with_objects(tmp_path: Path) -> None:
    result = small()
    none = Association(np.full(len(result.rays), -1), result.association.label)
    write_result(dataclasses.replace(result, association=none, residual=np.full(len(result.rays), np.nan)), tmp_path)
    table = pq.read_table(tmp_path / "rays.parquet")
    assert table["object"].null_count == table["residual"].null_count == len(result.rays)
