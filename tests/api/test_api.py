"""The Python interface: arrays go in, a map comes out, and what is wrong is one clear line."""

from __future__ import annotations

import builtins
import json
import logging
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from quick import HELD, NOTHING_DRAWN
from scipy.spatial.transform import Rotation
from small_log import THINGS, small_log
from waiting import LIMIT

import objslam
from objslam.api.mapping import prior_map
from objslam.association.registration import object_maps
from objslam.config import load_settings
from objslam.core.diagnostics import Ledger
from objslam.core.object_map import COLUMNS
from objslam.core.types import Log
from objslam.errors import ConfigError, LogError, ObjslamError, OutputError
from objslam.mapping import pipeline
from objslam.sources.log_folder import write_log_folder

QUICK = load_settings(None, (*HELD, *NOTHING_DRAWN))


@pytest.fixture(scope="module")
def log() -> Log:
    return small_log()


@pytest.fixture(scope="module")
def result(log: Log) -> objslam.Result:
    return objslam.run(log, QUICK)


def errors_of(result: objslam.Result) -> float:
    """The largest distance of an object from its true place, m."""
    truth = {label: np.array(at) for label, at in THINGS}
    assert {o.label for o in result.objects} == set(truth)
    return max(float(np.linalg.norm(o.position - truth[o.label])) for o in result.objects)


def test_the_import_alone_imports_nothing_heavy() -> None:
    code = (
        "import sys, objslam; dir(objslam); print([m for m in ('numpy', 'pydantic', 'gtsam', 'typer') if m in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_every_public_name_is_there_and_no_other() -> None:
    for name in objslam.__all__:
        assert getattr(objslam, name) is not None
    assert set(dir(objslam)) == set(objslam.__all__)
    with pytest.raises(AttributeError, match="no attribute 'nothing'"):
        objslam.nothing  # noqa: B018


def test_a_run_of_arrays_is_the_run_of_the_command(log: Log, result: objslam.Result) -> None:
    assert errors_of(result) < 0.03
    known = pipeline.run(log, load_settings(None, HELD), Ledger())
    np.testing.assert_array_equal(result.objects.positions, [o.position for o in known.map.objects])
    np.testing.assert_array_equal(result.objects.covariances, [o.covariance for o in known.map.objects])


def test_a_log_of_arrays_gives_the_same_map_in_every_form_of_a_pose(log: Log, result: objslam.Result) -> None:
    path, first = log.localization, log.cameras[0]
    assert path is not None
    assert first.detections is not None
    boxes = first.detections
    frames = range(len(boxes.frame_stamps))
    detections = objslam.Detections.from_frames(
        boxes.frame_stamps,
        [boxes.boxes[boxes.frame == k] for k in frames],
        [[boxes.label_names[i] for i in boxes.label[boxes.frame == k]] for k in frames],
        [boxes.scores[boxes.frame == k] for k in frames],
    )
    yaw = np.arctan2(path.poses[:, 1, 0], path.poses[:, 0, 0])
    turns = Rotation.from_matrix(path.poses[:, :3, :3]).as_quat()
    for poses in (
        path.poses,
        np.column_stack([path.poses[:, :2, 3], yaw]),
        np.column_stack([path.poses[:, :3, 3], 2.0 * turns]),  # a quaternion of any length
    ):
        made = objslam.Log.from_arrays(first.camera, detections, localization=(path.stamps, poses))
        mapped = objslam.run(made, QUICK)
        np.testing.assert_allclose(mapped.objects.positions, result.objects.positions, atol=1e-9)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"stamps": [0.0, 0.0]}, "stamp 1 is not later than the one before it"),
        ({"stamps": [0.0, np.nan]}, "stamp 1 is not a finite number of seconds"),
        ({"stamps": [0.0]}, "boxes needs one list for each stamp, got 2 for 1"),
        ({"labels": [["cup"], []]}, "frame 1: labels needs one list with one name for each of its 1 boxes, got 0"),
        ({"labels": [["cup"], "c"]}, "frame 1: labels needs one list with one name for each of its 1 boxes, got 'c'"),
        ({"labels": [["cup"]]}, "labels needs one list for each frame, got 1 for 2"),
        ({"boxes": [[[0, 0, 5, 5]], [[5, 5, 4, 9]]]}, "frame 1: box without area"),
        ({"boxes": [[[0, 0, 5, 5]], [[1, 1, 6]]]}, "frame 1: boxes are .B, 4. x1, y1, x2, y2, got the shape .1, 3."),
        ({"boxes": [[[0, 0, 5, 5]], [1, 1, 6, 6]]}, "frame 1: boxes are .B, 4. x1, y1, x2, y2, got the shape .4,."),
        ({"labels": [["cup"], [""]]}, "frame 1: box with a label that is no printable text"),
        ({"scores": [[0.5], [1.5]]}, "frame 1: box with a score outside 0 to 1"),
        ({"scores": [[0.5], []]}, "scores needs one list for each frame"),
        ({"depths": [[1.0], [-1.0]]}, "frame 1: box with a depth that is not above zero"),
    ],
)
def test_wrong_frames_are_named(changes: dict[str, Any], message: str) -> None:
    right: dict[str, Any] = {"stamps": [0.0, 1.0], "boxes": [[[0, 0, 5, 5]], [[1, 1, 6, 6]]], "labels": [["cup"], ["cup"]]}
    assert len(objslam.Detections.from_frames(**right)) == 2
    with pytest.raises(ValueError, match=message):
        objslam.Detections.from_frames(**{**right, **changes})


def test_labels_of_numpy_become_plain_text() -> None:
    """A message that quotes the name of a label would show np.str_('cup')."""
    found = objslam.Detections.from_frames([0.0], [[[0, 0, 5, 5]]], [np.array(["cup"])])
    assert [repr(name) for name in found.label_names] == ["'cup'"]


@pytest.mark.parametrize(
    ("poses", "message"),
    [
        ([[0.0, 0.0, 0.0], [0.0, np.inf, 0.0]], "pose 1 is not finite"),
        ([[0.0, 0.0], [1.0, 0.0]], "poses are .N, 3. x, y, yaw"),
        ([[0.0, 0.0, 0.0]], "one pose for each stamp, got 1 for 2"),
        ([np.eye(4), 2 * np.eye(4)], "pose 1 is not finite, too far away or not rigid"),
        ([[0.0, 0, 0, 0, 0, 0, 0], [0.0, 0, 0, 0, 0, 0, 1]], "pose 0 is not finite, too far away or not rigid"),
    ],
)
def test_wrong_poses_are_named(poses: Any, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        objslam.Trajectory.from_arrays([0.0, 1.0], poses)
    log = small_log()
    camera, found = log.cameras[0].camera, log.cameras[0].detections
    for path in ("odometry", "localization"):  # A log has two paths, so it names the wrong one.
        with pytest.raises(ValueError, match=f"^{path}: .*{message}"):
            objslam.Log.from_arrays(camera, found, **{path: ([0.0, 1.0], poses)})


def test_a_camera_may_have_lists_in_place_of_arrays(log: Log) -> None:
    camera, boxes = log.cameras[0].camera, log.cameras[0].detections
    assert boxes is not None
    lists: Any = {name: getattr(camera, name).tolist() for name in ("matrix", "distortion", "base_T_camera")}
    made = objslam.Log.from_arrays(replace(camera, **lists), boxes, odometry=log.odometry).cameras[0].camera
    for name in lists:
        np.testing.assert_array_equal(getattr(made, name), getattr(camera, name))
    with pytest.raises(ValueError, match=r"matrix is \(3, 3\), got the shape \(4, 4\)"):
        objslam.Log.from_arrays(replace(camera, matrix=np.eye(4)), boxes, odometry=log.odometry)


def test_a_wrong_number_of_lens_coefficients_is_told(log: Log) -> None:
    camera = log.cameras[0]
    told = "whose lens model plumb_bob takes 4 or 5 coefficients, got 3"
    with pytest.raises(ValueError, match=told):
        objslam.Log.from_arrays(
            replace(camera.camera, distortion=[0, 0, 0]), camera.detections, localization=log.localization
        )


def test_rays_print_as_one_line(result: objslam.Result) -> None:
    free = sum(one is None for one in result.rays.to_arrow()["object"].to_pylist())
    assert repr(result.rays) == f"RaysTable of {len(result.rays)} rays, {free} of no object"


def test_a_path_in_place_of_a_log_is_refused_in_one_line() -> None:
    given: Any = "my_log"
    with pytest.raises(TypeError, match=r"run needs a log, as `objslam\.read\(path\)` returns it, got str"):
        objslam.run(given)


def test_results_are_compared_by_identity_without_an_error(result: objslam.Result, tmp_path: Any) -> None:
    result.save(tmp_path / "out")
    loaded = objslam.Result.load(tmp_path / "out")
    assert loaded == loaded
    assert loaded != result


def test_a_log_that_cannot_be_is_refused(log: Log) -> None:
    camera, boxes = log.cameras[0].camera, log.cameras[0].detections
    assert boxes is not None
    with pytest.raises(ValueError, match="a log needs odometry, localization or both"):
        objslam.Log.from_arrays(camera, boxes)
    with pytest.raises(ValueError, match="each camera needs its detections"):
        objslam.Log.from_arrays([camera, camera], [boxes], odometry=log.odometry)
    with pytest.raises(ValueError, match="'left' without a size"):
        objslam.Log.from_arrays(replace(camera, width=0), boxes, odometry=log.odometry)


def test_what_reading_drops_is_logged_and_counted_once(log: Log, tmp_path: Any, caplog: pytest.LogCaptureFixture) -> None:
    write_log_folder(log, tmp_path / "log")
    with (tmp_path / "log" / "localization.txt").open("a") as file:
        file.write("rubbish\n")
    with caplog.at_level(logging.WARNING, "objslam"):
        again = objslam.read(tmp_path / "log")
        read = len([r for r in caplog.records if "dropped 1" in r.message])
        mapped = objslam.run(again, QUICK), objslam.run(again, QUICK)
    assert read == 1
    assert len([r for r in caplog.records if "dropped 1:" in r.message]) == 1
    for one in mapped:  # a second run of the same log counts anew
        assert list(one.dropped.values()).count(1) == 1
        assert len([line for line in one.warnings if line.startswith("dropped 1:")]) == 1


def test_wrong_options_and_settings_are_one_line(log: Log, tmp_path: Any) -> None:
    with pytest.raises(ConfigError, match="there is no option 'robots'"):
        objslam.read(tmp_path, robots=1)
    with pytest.raises(LogError, match="the folder is empty"):
        objslam.read(tmp_path)
    with pytest.raises(ConfigError, match=r"there is no setting rays\.pixel_sgma"):
        objslam.run(log, {"rays.pixel_sgma": 2})
    with pytest.raises(ConfigError, match="ready settings: "):
        objslam.run(log, "no_such_settings")


def test_settings_come_in_every_form() -> None:
    from objslam.api.mapping import settings_of

    assert settings_of(None, {}) == objslam.Settings()
    changed = settings_of({"mode": "joint", "rays.pixel_sigma": 2}, {"rays": {"border": 5}})
    assert (changed.mode, changed.rays.pixel_sigma, changed.rays.border) == ("joint", 2.0, 5.0)
    assert settings_of(changed, {"mode": "fixed"}).rays == changed.rays
    assert settings_of("odometry", {"mode": "fixed"}).mode == "fixed"
    assert settings_of("odometry", {}).mode == "joint"


def test_a_saved_result_loads_as_it_was(result: objslam.Result, tmp_path: Any) -> None:
    result.save(tmp_path / "out")
    loaded = objslam.Result.load(tmp_path / "out")
    np.testing.assert_array_equal(loaded.objects.positions, result.objects.positions)
    np.testing.assert_array_equal(loaded.objects.covariances, result.objects.covariances)
    np.testing.assert_allclose(loaded.path.poses, result.path.poses, atol=1e-8)
    np.testing.assert_array_equal(loaded.rays.object, result.rays.object)
    assert loaded.summary == json.loads(json.dumps(result.summary))
    loaded.save(tmp_path / "copy")
    for file in (tmp_path / "out").iterdir():
        assert (tmp_path / "copy" / file.name).read_bytes() == file.read_bytes()
    with pytest.raises(OutputError, match="there is no such result folder"):
        objslam.Result.load(tmp_path / "nowhere")


def test_maps_are_registered_from_results_maps_and_paths_alike(result: objslam.Result, tmp_path: Any) -> None:
    result.save(tmp_path / "out")
    file = tmp_path / "alone.json"
    result.objects.save(file)
    expected = object_maps.register(result.objects, result.objects)
    assert len(expected.matches) == len(THINGS)
    loaded = objslam.Result.load(tmp_path / "out")
    for given in (result.objects, result, loaded, tmp_path / "out", str(tmp_path / "out"), file):
        for pair in ((given, result.objects), (result.objects, given)):
            found = objslam.register(*pair)
            np.testing.assert_allclose(found.b_T_a, expected.b_T_a, atol=1e-6)
            np.testing.assert_array_equal(found.matches, expected.matches)
    with pytest.raises(OutputError, match="absent"):
        objslam.register(tmp_path / "absent", result)


def test_pushes_before_the_start_are_counted_in_the_snapshot() -> None:
    session = objslam.Session()
    assert not session.push_detections(1.0, "front", [[1, 2, 30, 40]], ["cup"], [0.5])
    assert not session.push_odometry(1.0, [1, 2])
    assert sum(session.snapshot().dropped.values()) == 2


def test_pushes_after_the_end_are_counted_in_the_snapshot(log: Log) -> None:
    with objslam.Session() as session:
        session.push_camera(log.cameras[0].camera)
    assert not session.push_odometry(1.0, [1, 2])
    assert sum(session.snapshot().dropped.values()) == 1


def test_a_session_maps_what_is_pushed(log: Log) -> None:
    camera, boxes, path = log.cameras[0].camera, log.cameras[0].detections, log.localization
    assert boxes is not None
    assert path is not None
    known = {"focal": 0.0, "centre": 0.0}  # The simulated camera is calibrated.
    with objslam.Session(poses={"use": "localization"}, calibration=known, patient=True) as session:
        assert session.push_camera(camera)
        at = 0
        for k, stamp in enumerate(boxes.frame_stamps):
            while at < len(path) and path.stamps[at] <= stamp:
                pose = path.poses[at]
                yaw = np.arctan2(pose[1, 0], pose[0, 0])
                assert session.push_localization(path.stamps[at], [pose[0, 3], pose[1, 3], yaw])
                at += 1
            mine = boxes.frame == k
            names = [boxes.label_names[i] for i in boxes.label[mine]]
            assert session.push_detections(stamp, "left", boxes.boxes[mine], names, boxes.scores[mine])
        assert not session.push_localization(path.stamps[-1] + 1, ["x"])
        assert session.wait(LIMIT)
        now = session.snapshot()
        assert isinstance(now.map, objslam.ObjectMap)
        assert now.dropped["localization without a rigid pose"] == 1
        assert errors_of(session.result()) < 0.03


def test_frames_that_are_pushed_after_all_poses_are_told_the_right_order(log: Log) -> None:
    camera, boxes, path = log.cameras[0].camera, log.cameras[0].detections, log.localization
    assert boxes is not None
    assert path is not None
    with objslam.Session(poses={"use": "localization"}, patient=True, live={"max_late": 5.0}) as session:
        session.push_camera(camera)
        for stamp, pose in zip(path.stamps, path.poses, strict=True):
            session.push_localization(stamp, pose)
        for k, stamp in enumerate(boxes.frame_stamps):
            mine = boxes.frame == k
            names = [boxes.label_names[i] for i in boxes.label[mine]]
            session.push_detections(stamp, "left", boxes.boxes[mine], names, boxes.scores[mine])
        result = session.result()
    assert any("in the order of their stamps" in warning for warning in result.summary["warnings"])


def test_tables_hold_every_number(result: objslam.Result) -> None:
    table = result.objects.to_arrow()
    assert table.column_names == list(COLUMNS)
    rows = table.to_pylist()
    for row, one in zip(rows, result.objects, strict=True):
        assert [row["x"], row["y"], row["z"]] == one.position.tolist()
        assert one.covariance is not None
        assert row["cov_xz"] == one.covariance[0, 2]
    lost = objslam.ObjectMap((replace(result.objects[0], covariance=None, position=np.full(3, np.nan)),))
    assert lost.to_arrow().to_pylist()[0]["x"] is None
    assert objslam.ObjectMap(()).to_arrow().schema == table.schema
    assert result.rays.to_arrow().num_rows == len(result.rays)
    poses = result.poses.to_arrow()
    np.testing.assert_array_equal(poses["x"].to_numpy(), result.poses.poses[:, 0, 3])


def test_without_pandas_one_line_says_so(result: objslam.Result, monkeypatch: pytest.MonkeyPatch) -> None:
    real = builtins.__import__

    def without(name: str, *more: Any, **given: Any) -> Any:
        if name == "pandas":
            raise ModuleNotFoundError(name)
        return real(name, *more, **given)

    monkeypatch.setattr(builtins, "__import__", without)
    with pytest.raises(ObjslamError, match=r"pandas is not installed \(pip install pandas, or use to_arrow\(\)\)"):
        result.objects.to_pandas()


def test_a_map_is_a_sequence_that_can_be_read(result: objslam.Result) -> None:
    objects = result.objects
    assert list(objects) == list(objects.objects)
    assert objects[-1] is objects.objects[-1]
    assert [o.id for o in objects[1:3]] == [objects[1].id, objects[2].id]
    assert isinstance(objects[:1], objslam.ObjectMap)
    assert objects.by_id(objects[2].id) is objects[2]
    with pytest.raises(KeyError, match="no object with the id 99"):
        objects.by_id(99)
    lines = repr(objects).splitlines()
    assert lines[0] == "ObjectMap of 4 objects (0 unresolved) in the frame 'map'"
    assert "cup" in repr(objects)
    assert len(repr(objslam.ObjectMap(objects.objects * 10)).splitlines()) == 22
    assert "... and 20 more" in repr(objslam.ObjectMap(objects.objects * 10))


def test_a_result_is_the_map_of_another_day_as_its_folder_is(result: objslam.Result, tmp_path: Path) -> None:
    result.save(tmp_path / "map")
    summary = {**result.summary, "up": "y"}
    (tmp_path / "map" / "summary.json").write_text(json.dumps({"up": "y"}))
    given, loaded = prior_map(replace(result, summary=summary)), prior_map(tmp_path / "map")
    assert given.up == loaded.up == "y"
    assert np.allclose(given.objects.positions, loaded.objects.positions, equal_nan=True)
    objslam.Session(map=result).abort()


def test_integers_are_labels_of_arrays_too():
    found = objslam.Detections.from_frames([0.0], [[[0, 0, 5, 5], [1, 1, 4, 4]]], [[3, np.int64(0)]])
    assert found.labels == ["3", "0"]
    with pytest.raises(ValueError, match="no printable text"):
        objslam.Detections.from_frames([0.0], [[[0, 0, 5, 5]]], [[None]])  # type: ignore[list-item]


def test_cameras_need_names_of_their_own(log):
    one = log.cameras[0]
    with pytest.raises(ValueError, match="a name of its own"):
        objslam.Log.from_arrays([one.camera, one.camera], [one.detections, one.detections], odometry=log.odometry)


def test_a_query_that_can_hold_nothing_is_an_error(result):
    with pytest.raises(ValueError, match="0 m or more"):
        result.objects.in_radius([0, 0], -1)
    with pytest.raises(ValueError, match="must not lie above"):
        result.objects.in_box([1, 1], [0, 2])


def test_one_path_is_no_sequence_of_sessions(tmp_path):
    with pytest.raises(ValueError, match="got the one path"):
        objslam.merge(str(tmp_path))
