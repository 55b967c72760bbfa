import json
import os
import re
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from faults import in_child, killed_at
from hypothesis import given, settings
from hypothesis import strategies as st

from objslam.core.camera import Camera
from objslam.core.diagnostics import Ledger
from objslam.core.geometry import lift_se2
from objslam.core.trajectory import Trajectory
from objslam.core.types import CameraLog, Detections, Images, Log, Truth, TruthObject
from objslam.errors import LogError, OutputError
from objslam.io import folders
from objslam.io.objects_json import read_truth_objects
from objslam.sources import log_folder as folder_module
from objslam.sources.log_folder import is_log_folder, read_log_folder, write_log_folder, write_path
from objslam.sources.no_camera import NoCamera

_POSE = "1 0 0 0 0 0 0 1\n"


def _trajectory(seed):
    rng = np.random.default_rng(seed)
    return Trajectory(1.7e9 + np.cumsum(rng.uniform(0.01, 0.1, 30)), lift_se2(rng.normal(size=(30, 3))))


def _camera_log(name, images):
    detections = Detections(
        frame_stamps=np.array([1.0, 2.0, 3.0]),
        frame=np.array([0, 2]),
        boxes=np.array([[1.0, 2, 3, 4], [5, 6, 7, 8]]),
        label=np.array([1, 0]),
        scores=np.array([0.5, 1.0]),
        depths=np.array([np.nan, 1 / 3]),
        track_ids=np.array([4, -1]),
        label_names=("chair", "cup"),
    )
    camera = Camera(name, 640, 480, np.array([[500.0, 0, 320], [0, 500, 240], [0, 0, 1]]), depth_scale=5000.0)
    stream = Images(np.array([1.0, 2.0]), images)
    return CameraLog(
        camera, detections, rgb=stream, depth=replace(stream, stamps=np.array([1.01, 2.01])), mount=_trajectory(7)
    )


@pytest.fixture
def log(tmp_path):
    folder = tmp_path / "recorded"
    folder.mkdir()
    images = (folder / "a.png", folder / "b.png")
    for image in images:
        image.write_bytes(image.name.encode())
    cup = TruthObject(3, "cup", np.array([0.1, 0.2, 1 / 3]))
    size, turn = np.array([1.2, 0.6, 2 / 3]), np.array([0.0, 0.0, 0.6, 0.8])
    desk = TruthObject(4, "desk", np.array([1.0, 2, 1 / 3]), size, 0.3, turn)
    truth = Truth((cup, desk), _trajectory(3))
    return Log("made", (_camera_log("front", images),), _trajectory(1), _trajectory(2), truth)


def _same_path(a, b):
    assert np.array_equal(a.stamps, b.stamps)
    np.testing.assert_allclose(a.poses, b.poses, atol=1e-15)


def _assert_same(read, log):
    _same_path(read.odometry, log.odometry)
    _same_path(read.localization, log.localization)
    _same_path(read.truth.trajectory, log.truth.trajectory)
    for a, b in zip(read.truth.objects, log.truth.objects, strict=True):
        assert (a.id, a.label, a.position.tolist(), a.yaw) == (b.id, b.label, b.position.tolist(), b.yaw)
        for own, other in ((a.size, b.size), (a.tag_xyzw, b.tag_xyzw)):
            assert (own is None) == (other is None)
            assert own is None or np.abs(own - other).max() < 1e-12
    for a, b in zip(read.cameras, log.cameras, strict=True):
        assert (a.camera.name, a.camera.width, a.camera.depth_scale) == (b.camera.name, b.camera.width, b.camera.depth_scale)
        _same_path(a.mount, b.mount)
        for field, value in vars(b.detections).items():
            np.testing.assert_array_equal(getattr(a.detections, field), value)
        for stream in ("rgb", "depth"):
            images, expected = getattr(a, stream), getattr(b, stream)
            assert np.array_equal(images.stamps, expected.stamps)
            assert [p.read_bytes() for p in images.paths] == [p.read_bytes() for p in expected.paths]


def test_a_log_with_everything_reads_back(log, tmp_path):
    out = tmp_path / "deep" / "out"
    write_log_folder(log, out)
    ledger = Ledger()
    read = read_log_folder(out, ledger)
    assert not ledger.lines()
    assert read.name == "out"
    _assert_same(read, log)
    assert [p.relative_to(out).as_posix() for p in read.cameras[0].depth.paths] == ["depth/a.png", "depth/b.png"]
    assert sorted(p.name for p in out.parent.iterdir()) == ["out"]  # nothing temporary stays
    assert is_log_folder(out)
    assert read_truth_objects(out / "groundtruth" / "objects.json")[0].id == 3


def test_several_cameras_read_back(log, tmp_path):
    images = log.cameras[0].rgb.paths
    log = replace(log, cameras=(_camera_log("left", images), _camera_log("right", images[::-1])))
    write_log_folder(log, tmp_path / "out")
    assert (tmp_path / "out" / "cameras" / "left" / "rgb" / "a.png").is_file()
    ledger = Ledger()
    _assert_same(read_log_folder(tmp_path / "out", ledger), log)
    assert not ledger.lines()


def test_only_what_is_there_is_written(log, tmp_path):
    bare = Log("bare", (CameraLog(log.cameras[0].camera),), localization=log.localization)
    write_log_folder(bare, tmp_path / "out")
    assert sorted(p.name for p in (tmp_path / "out").iterdir()) == ["camera.yaml", "localization.txt"]
    read = read_log_folder(tmp_path / "out", Ledger())
    assert (read.odometry, read.truth, read.cameras[0].detections, read.cameras[0].rgb) == (None, None, None, None)


def test_images_of_one_name_stay_apart(log, tmp_path):
    other = tmp_path / "more" / "a.png"
    other.parent.mkdir()
    other.write_bytes(b"other")
    camera_log = replace(log.cameras[0], rgb=Images(np.array([1.0, 2.0, 3.0]), (log.cameras[0].rgb.paths[0], other, other)))
    write_log_folder(replace(log, cameras=(camera_log,)), tmp_path / "out")
    read = read_log_folder(tmp_path / "out", Ledger())
    assert [p.read_bytes() for p in read.cameras[0].rgb.paths] == [b"a.png", b"other", b"other"]


def test_images_are_copied_where_they_cannot_be_linked(log, tmp_path, monkeypatch):
    def refuse(*_):
        raise OSError(18, "Invalid cross-device link")

    monkeypatch.setattr(os, "link", refuse)
    write_log_folder(log, tmp_path / "out")
    _assert_same(read_log_folder(tmp_path / "out", Ledger()), log)


def test_a_log_is_replaced_only_when_asked_and_keeps_its_images(log, tmp_path):
    out = tmp_path / "out"
    write_log_folder(log, out)
    (out / "notes.txt").write_text("mine")
    with pytest.raises(OutputError, match="there is a log already"):
        write_log_folder(log, out)
    assert (out / "notes.txt").exists()
    read = read_log_folder(out, Ledger())
    write_log_folder(read, out, overwrite=True)
    again = read_log_folder(out, Ledger())
    assert [p.relative_to(out).as_posix() for p in again.cameras[0].rgb.paths] == ["rgb/a.png", "rgb/b.png"]
    _assert_same(again, log)
    assert not (out / "notes.txt").exists()


def test_a_link_to_a_log_stays_a_link(log, tmp_path):
    write_log_folder(log, tmp_path / "out")
    (tmp_path / "alias").symlink_to("out")
    write_log_folder(log, tmp_path / "alias", overwrite=True)
    assert (tmp_path / "alias").is_symlink()
    _assert_same(read_log_folder(tmp_path / "alias", Ledger()), log)


def test_what_is_no_log_is_never_replaced(log, tmp_path):
    (tmp_path / "file").write_text("mine")
    (tmp_path / "photos").mkdir()
    (tmp_path / "photos" / "cat.png").write_text("mine")
    (tmp_path / "empty").mkdir()
    for name in ("file", "photos"):
        with pytest.raises(OutputError) as caught:
            write_log_folder(log, tmp_path / name, overwrite=True)
        assert caught.value.where == str(tmp_path / name)
    assert (tmp_path / "photos" / "cat.png").read_text() == "mine"
    write_log_folder(log, tmp_path / "empty")
    assert is_log_folder(tmp_path / "empty")


def test_a_path_without_a_camera_is_replaced_if_asked(log, tmp_path):
    """As a second conversion of a bag without images does."""
    found = NoCamera("no camera", "bag", "", log.odometry, log.localization, {})
    write_path(found, tmp_path / "out")
    with pytest.raises(OutputError, match="--overwrite"):
        write_path(found, tmp_path / "out")
    write_path(found, tmp_path / "out", overwrite=True)
    assert {file.name for file in (tmp_path / "out").iterdir()} <= {"odometry.txt", "localization.txt"}


@pytest.mark.parametrize("error", [OSError(28, "No space left on device"), KeyboardInterrupt()])
def test_a_write_that_fails_leaves_the_old_log_and_nothing_else(log, tmp_path, monkeypatch, error):
    out = tmp_path / "logs" / "out"
    write_log_folder(log, out)

    def fail(*_):
        raise error

    monkeypatch.setattr(folder_module, "write_detections", fail)
    with pytest.raises(OutputError if isinstance(error, OSError) else KeyboardInterrupt):
        write_log_folder(log, out, overwrite=True)
    assert [p.name for p in out.parent.iterdir()] == ["out"]
    _assert_same(read_log_folder(out, Ledger()), log)


def test_what_cannot_be_written(log, tmp_path):
    (camera_log,) = log.cameras
    lost = replace(camera_log, rgb=Images(np.array([1.0]), (tmp_path / "lost.png",)))
    for bad, message in (
        (replace(log, cameras=()), "without cameras"),
        (replace(log, odometry=None, localization=None), "without odometry or localization"),
        (replace(log, cameras=(camera_log, camera_log)), "names must differ"),
        (replace(log, cameras=(camera_log, _camera_log("../x", camera_log.rgb.paths))), "folder names"),
        (replace(log, cameras=(lost,)), "lost.png"),
    ):
        with pytest.raises(OutputError) as caught:
            write_log_folder(bad, tmp_path / "out")
        assert message in str(caught.value)
        assert not (tmp_path / "out").exists()


@pytest.fixture
def written(log, tmp_path):
    write_log_folder(log, tmp_path / "log")
    return tmp_path / "log"


def test_a_path_under_another_name_is_named(written):
    (written / "odometry.txt").unlink()
    (written / "localization.txt").rename(written / "localization.csv")
    with pytest.raises(LogError, match=r"found localization\.csv: rename it to localization\.txt"):
        read_log_folder(written, Ledger())


def test_a_file_whose_name_is_probably_misspelt_is_named(written):
    """A file of another name, or beside the file that is meant, is nobody's mistake."""
    (written / "localization.txt").rename(written / "localisation.txt")
    (written / "odometry.txt.old").write_text("")
    (written / "notes.txt").write_text("")
    ledger = Ledger()
    assert read_log_folder(written, ledger).localization is None
    (line,) = ledger.lines()
    assert line == (
        f"{written / 'localisation.txt'}: no file of a log has this name, so it is not read (did you mean localization.txt?)"
    )


def test_a_key_of_a_camera_that_is_probably_misspelt_is_named(written):
    """Keys that ROS writes, and keys that resemble none, may be there."""
    file = written / "camera.yaml"
    ros = "projection_matrix: {rows: 3, cols: 4, data: [1]}\nroi: 3\n"
    file.write_text(re.sub("sees_size: [a-z]*\n", "", file.read_text()) + "sees_sizes: false\n" + ros)
    ledger = Ledger()
    read_log_folder(written, ledger)
    assert ledger.lines() == [f"{file}: the key sees_sizes is not known, and is not read (did you mean sees_size?)"]


def test_neither_path(written):
    (written / "odometry.txt").unlink()
    (written / "localization.txt").unlink()
    with pytest.raises(LogError, match=r"neither odometry\.txt nor localization\.txt"):
        read_log_folder(written, Ledger())


@pytest.mark.parametrize("content", [b"", b"a b c\n", b"1 0 0 0 0 0 0 nan\n", None])
def test_a_path_that_cannot_be_used(written, content):
    def spoil(file):
        file.unlink()
        file.mkdir() if content is None else file.write_bytes(content)

    spoil(written / "localization.txt")
    ledger = Ledger()
    log = read_log_folder(written, ledger)
    assert log.localization is None
    assert log.odometry is not None
    assert str(written / "localization.txt") in ledger.warnings[0]
    assert ledger.unused == ["localization.txt"]
    spoil(written / "odometry.txt")
    with pytest.raises(LogError) as caught:
        read_log_folder(written, Ledger())
    assert caught.value.where == str(written / "odometry.txt")


def test_no_camera(written):
    (written / "camera.yaml").unlink()
    with pytest.raises(LogError) as caught:
        read_log_folder(written, Ledger())
    assert caught.value.where == str(written)
    assert "there is no camera.yaml (write one with" in str(caught.value)
    (written / "cameras").mkdir()
    (written / "cameras" / ".hidden").mkdir()
    (written / "cameras" / "notes.txt").touch()
    with pytest.raises(LogError, match="no camera"):
        read_log_folder(written, Ledger())
    (written / "cameras" / "left").mkdir()
    with pytest.raises(LogError) as caught:
        read_log_folder(written, Ledger())
    assert caught.value.where == str(written / "cameras" / "left")


def test_both_forms_of_cameras(written):
    (written / "cameras").mkdir()
    with pytest.raises(LogError, match="both"):
        read_log_folder(written, Ledger())


@pytest.mark.parametrize("name", ["detections.jsonl", "camera_poses.txt"])
@pytest.mark.parametrize("content", [b"", b"\x00\x01\x02", b"{}\n"])
def test_detections_and_a_mount_must_be_usable_where_they_are_there(written, name, content):
    (written / name).write_bytes(content)
    with pytest.raises(LogError) as caught:
        read_log_folder(written, Ledger())
    assert caught.value.where == str(written / name)


@pytest.mark.parametrize("name", ["rgb.txt", "depth.txt", "groundtruth/objects.json", "groundtruth/trajectory.txt"])
@pytest.mark.parametrize("content", [b"", b"\xff\xfe\x00", b'{"objects": 3}', None])
def test_optional_parts_are_left_out_with_a_warning(written, name, content):
    (written / name).unlink()
    if content is None:
        (written / name).mkdir()
    else:
        (written / name).write_bytes(content)
    ledger = Ledger()
    log = read_log_folder(written, ledger)
    assert log.odometry is not None
    assert [str(written / name) in warning for warning in ledger.warnings] == [True]


def test_a_mounted_camera_needs_no_place_of_its_own(written):
    file = written / "camera.yaml"
    lines = file.read_text().splitlines()
    at = lines.index("base_T_camera:")
    file.write_text("\n".join(lines[:at] + lines[at + 3 :]))
    assert read_log_folder(written, Ledger()).cameras[0].mount is not None
    (written / "camera_poses.txt").unlink()
    with pytest.raises(LogError, match="base_T_camera is missing"):
        read_log_folder(written, Ledger())


def test_what_is_no_folder(tmp_path):
    (tmp_path / "file").touch()
    for name, message in (("missing", "no such folder"), ("file", "not a folder"), ("x" * 300, "name too long")):
        with pytest.raises(LogError, match=message):
            read_log_folder(tmp_path / name, Ledger())


_PARTS = {
    "camera.yaml": "image_width: 640\nimage_height: 480\ncamera_matrix: [5e2, 0, 320, 0, 5e2, 240, 0, 0, 1]\n"
    "distortion_model: plumb_bob\ndistortion_coefficients: []\n"
    "base_T_camera: {translation: [0, 0, 1], rotation_xyzw: [0, 0, 0, 1]}\n",
    "odometry.txt": _POSE + _POSE.replace("1", "2", 1),
    "camera_poses.txt": _POSE,
    "detections.jsonl": '{"stamp": 1.5, "boxes": [[1, 2, 3, 4]], "labels": ["cup"], "scores": [0.9], "depths": [null]}\n',
    "rgb.txt": "1.5 a.png\n",
    "groundtruth/objects.json": '{"objects": [{"id": 1, "label": "cup", "position": [1, 2, 3]}]}',
}


@settings(max_examples=150)
@given(st.data())
def test_damage_of_any_kind_ends_in_a_log_or_one_clear_error(data):
    name = data.draw(st.sampled_from(sorted(_PARTS)))
    content = _PARTS[name].encode()
    start = data.draw(st.integers(0, len(content)))
    end = data.draw(st.integers(start, len(content)))
    words = st.sampled_from(
        [b"nan", b"inf", b"-1", b"1e999", b"9" * 400, b"null", b"[", b"{", b"\n", b"\0", b"\xff", b"*a", b"!!"]
    )
    damaged = content[:start] + data.draw(st.binary(max_size=5) | words) + content[end:]
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        (folder / "groundtruth").mkdir()
        (folder / "a.png").touch()
        for part, text in _PARTS.items():
            (folder / part).write_text(text)
        (folder / name).write_bytes(damaged)
        try:
            named = str(folder / name) if read_log_folder(folder, Ledger()).odometry else ""
        except LogError as error:
            named = error.where or ""
        assert named.startswith(str(folder / name))


def test_a_log_written_by_hand(tmp_path):
    (tmp_path / "camera.yaml").write_text(
        "image_width: 640\nimage_height: 480\ncamera_matrix: [[5e2, 0, 320], [0, 5e2, 240], [0, 0, 1]]\n"
        "distortion_model: plumb_bob\ndistortion_coefficients: []\n"
        "base_T_camera: {translation: [0, 0, 1], rotation_xyzw: [-0.5, 0.5, -0.5, 0.5]}\n"
    )
    (tmp_path / "odometry.txt").write_text(_POSE + _POSE.replace("1", "2", 1))
    frame = {"stamp": 1.5, "boxes": [[1, 2, 3, 4]], "labels": ["cup"], "scores": [0.9]}
    (tmp_path / "detections.jsonl").write_text(json.dumps(frame))
    ledger = Ledger()
    log = read_log_folder(tmp_path, ledger)
    assert not ledger.lines()
    assert log.name == tmp_path.name
    assert len(log.odometry) == 2
    assert log.cameras[0].camera.focal == 500
    assert log.cameras[0].detections.stamps.tolist() == [1.5]


@pytest.mark.forks
def test_what_killed_processes_left_goes_and_a_log_that_was_being_replaced_comes_back(log, tmp_path):
    """A killed process leaves its temporary folder beside the log, perhaps with the log that it was replacing."""
    place = tmp_path / "place"
    target = place / "log"
    for step in range(200):
        write_log_folder(log, target, overwrite=True)
        code = in_child(killed_at(step, lambda: write_log_folder(log, target, overwrite=True)))
        left = [entry for entry in place.iterdir() if entry.name.startswith(".log.")]
        assert bool(left) <= (code == -9)
        if code == 0:
            break
        if not target.exists():  # The process was killed between two renames.
            with pytest.raises(OutputError, match="there is a log already"):
                write_log_folder(log, target)
        assert is_log_folder(target)
    assert code == 0
    assert step > 1
    write_log_folder(log, target, overwrite=True)
    assert [entry.name for entry in place.iterdir()] == ["log"]


def test_leftovers_are_known_by_name_machine_and_dead_process(tmp_path, monkeypatch):
    dead = os.fork()
    if dead == 0:
        os._exit(0)
    os.waitpid(dead, 0)
    mine = folders.temporary_name(tmp_path / "log")
    machine = mine.removeprefix(".log.").split("-")[0]
    gone = (f".log.{machine}-{dead}", f".log.{machine}-{dead}.x1y2", f".log.{machine}-{dead}.png")
    alive = (mine, f"{mine}.abc", f".log.{machine}-1")
    others = (f".log.00000000-{dead}", f".log.{dead}", f".log2.{machine}-{dead}", ".log.x")
    stay = (*alive, *others, f".log.{machine}-{dead}x", f"log.{machine}-{dead}", f".log.{machine}-")
    for name in (*gone, *stay):
        (tmp_path / name).mkdir()
        (tmp_path / name / "a").touch()
    (tmp_path / f".log.{machine}-{dead}.link").symlink_to(tmp_path / mine)
    (tmp_path / f".log.{machine}-{dead}.file").touch()
    folders.remove_leftovers(tmp_path / "log")
    assert {entry.name for entry in tmp_path.iterdir()} == set(stay)
    assert (tmp_path / mine / "a").exists()
