"""A detector on a log: frames, what is skipped, the cache, depths."""

import json
import os
import shutil
import threading
from dataclasses import replace
from pathlib import Path

import cv2
import image_bombs
import numpy as np
import pytest
from image_bombs import SIDE
from tiny_models import COLOURS, scene, tiny_model
from waiting import LIMIT

from objslam.config import Detector as DetectorSettings
from objslam.config import Settings
from objslam.core.camera import Camera
from objslam.core.diagnostics import Ledger
from objslam.core.trajectory import Trajectory
from objslam.core.types import CameraLog, Images, Log
from objslam.detection import default_cache, detect_log, load_detector
from objslam.detection.detector import Detector
from objslam.errors import DetectorError, LogError
from objslam.io.detections_jsonl import read_detections, write_detections
from objslam.io.threads import ahead

WIDTH, HEIGHT, FRAMES = 320, 240, 7


def truth(i):
    return [[20 + 5 * i, 30, 90 + 5 * i, 100], [200, 40 + 10 * i, 240, 90 + 10 * i]] if i != 3 else []


@pytest.fixture
def log(tmp_path):
    (tmp_path / "log").mkdir()
    files = [tmp_path / "log" / f"{i}.png" for i in range(FRAMES)]
    for i, file in enumerate(files):
        cv2.imwrite(str(file), scene(truth(i), WIDTH, HEIGHT))
    stamps = 10 + 0.1 * np.arange(FRAMES)
    path = Trajectory(stamps, np.tile(np.eye(4), (FRAMES, 1, 1)))
    return Log("log", (CameraLog(Camera("front", WIDTH, HEIGHT, np.eye(3)), rgb=Images(stamps, tuple(files))),), path)


@pytest.fixture
def detector(tmp_path):
    return load(tmp_path)


def load(folder, metadata=None, **settings):
    model = tiny_model(
        folder / "m.onnx", "yolov8", size=(320, 320), batch=None, metadata=metadata or {"names": list(COLOURS)}
    )
    return load_detector(model, DetectorSettings(**settings))


@pytest.fixture
def seen(monkeypatch):
    """How many images went through a network."""
    images, run = [], Detector.detect
    monkeypatch.setattr(Detector, "detect", lambda self, batch: images.extend(batch) or run(self, batch))
    return images


def with_camera(log, **changes):
    return replace(log, cameras=(replace(log.cameras[0], **changes),))


def same(a, b):
    assert a.label_names == b.label_names
    for name in ("frame_stamps", "frame", "boxes", "label", "scores", "depths", "track_ids"):
        assert np.array_equal(getattr(a, name), getattr(b, name), equal_nan=True), name


@pytest.mark.parametrize("batch", [1, 3])
def test_every_image_is_a_frame_with_its_boxes(log, tmp_path, batch):
    told, ledger = [], Ledger()
    found = detect_log(log, load(tmp_path, batch=batch), Settings(), ledger, progress=lambda *step: told.append(step))
    detections = found.cameras[0].detections
    assert detections.frame_stamps.tolist() == log.cameras[0].rgb.stamps.tolist()
    assert detections.label_names == ("green", "red")
    for i in range(FRAMES):
        mine = detections.take(detections.frame == i)
        order = [("red", "green").index(detections.label_names[k]) for k in mine.label]
        np.testing.assert_allclose(mine.boxes[np.argsort(order)], np.reshape(truth(i), (-1, 4)), atol=0.5)
    assert np.isnan(detections.depths).all()
    assert (detections.track_ids == -1).all()
    assert not ledger.lines()
    assert [step[1:] for step in told] == [(done, FRAMES) for done in range(FRAMES + 1)]
    assert {stage for stage, _, _ in told} == {"detecting"}  # A new name would start the clock of the bar again.
    assert log.cameras[0].detections is None  # the log that came in is as it was


def test_they_are_a_logs_own_detections_file(log, detector, tmp_path):
    detections = detect_log(log, detector, Settings(), Ledger()).cameras[0].detections
    write_detections(detections, tmp_path / "detections.jsonl")
    same(read_detections(tmp_path / "detections.jsonl", Ledger()), detections)


def test_images_that_cannot_be_used_are_no_frames(log, detector):
    files = log.cameras[0].rgb.paths
    files[0].write_bytes(files[0].read_bytes()[:200])
    files[1].write_bytes(b"no image")
    files[2].unlink()
    cv2.imwrite(str(files[4]), scene(truth(4), WIDTH * 2, HEIGHT))
    files[5].write_bytes(b"")
    ledger = Ledger()
    detections = detect_log(log, detector, Settings(), ledger).cameras[0].detections
    assert detections.frame_stamps.tolist() == log.cameras[0].rgb.stamps[[3, 6]].tolist()
    assert set(detections.frame) == {1}
    assert ledger.dropped == {
        "rgb image that cannot be decoded": 3,
        "rgb image that cannot be read": 1,
        "rgb image that does not have the camera's size": 1,
    }
    assert "4.png is 640x240, the camera 320x240" in ledger.examples["rgb image that does not have the camera's size"][0]
    assert "2.png" in ledger.examples["rgb image that cannot be read"][0]


def test_no_image_at_all(log, detector):
    with pytest.raises(LogError, match="no camera has rgb images"):
        detect_log(with_camera(log, rgb=None), detector, Settings(), Ledger())
    camera = replace(log.cameras[0].camera, width=640)
    with pytest.raises(LogError, match=r"none of the 7 rgb images can be used.*camera's size"):
        detect_log(with_camera(log, camera=camera), detector, Settings(), Ledger())


def test_an_image_of_absurd_size_is_not_unpacked(log, detector):
    """A PNG of some hundred kB that states gigabytes, in a camera's own folder."""
    bomb = image_bombs.png(SIDE, SIDE)
    log.cameras[0].rgb.paths[2].write_bytes(bomb)
    ledger = Ledger()
    detections = detect_log(log, detector, Settings(), ledger).cameras[0].detections
    assert len(bomb) < 1_000_000
    assert len(detections.frame_stamps) == FRAMES - 1
    assert ledger.dropped == {"rgb image that cannot be decoded": 1}


class TestCache:
    def test_a_second_run_does_not_detect_again(self, log, detector, tmp_path, seen):
        first = detect_log(log, detector, Settings(), Ledger(), cache=tmp_path / "cache")
        assert len(seen) == FRAMES
        again = detect_log(log, detector, Settings(), Ledger(), cache=tmp_path / "cache")
        assert len(seen) == FRAMES
        same(first.cameras[0].detections, again.cameras[0].detections)

    def test_a_log_that_was_copied_is_known(self, log, detector, tmp_path, seen):
        detect_log(log, detector, Settings(), Ledger(), cache=tmp_path / "cache")
        shutil.copytree(tmp_path / "log", tmp_path / "copy")
        rgb = log.cameras[0].rgb
        copied = replace(rgb, paths=tuple(tmp_path / "copy" / path.name for path in rgb.paths))
        detect_log(with_camera(log, rgb=copied), detector, Settings(), Ledger(), cache=tmp_path / "cache")
        assert len(seen) == FRAMES

    def test_an_image_with_another_content_is_another_image(self, log, detector, tmp_path, seen):
        detect_log(log, detector, Settings(), Ledger(), cache=tmp_path / "cache")
        file = log.cameras[0].rgb.paths[0]
        before = file.stat()
        cv2.imwrite(str(file), scene([[120, 30, 190, 100]], WIDTH, HEIGHT))
        os.utime(file, ns=(before.st_atime_ns, before.st_mtime_ns))
        detections = detect_log(log, detector, Settings(), Ledger(), cache=tmp_path / "cache").cameras[0].detections
        assert len(seen) == FRAMES + 1
        np.testing.assert_allclose(detections.boxes[detections.frame == 0], [[120, 30, 190, 100]], atol=0.5)

    def test_another_model_or_other_settings_detect_again(self, log, tmp_path, seen):
        for count, settings in enumerate(({}, {"min_score": 0.1}, {"classes": ("red",)}), start=1):
            detect_log(log, load(tmp_path, **settings), Settings(), Ledger(), cache=tmp_path / "cache")
            assert len(seen) == count * FRAMES
        detect_log(log, load(tmp_path, {"names": ["a", "b", "c"]}), Settings(), Ledger(), cache=tmp_path / "cache")
        assert len(seen) == 4 * FRAMES

    def test_what_fits_the_cache_may_still_not_fit_the_camera(self, log, detector, tmp_path):
        detect_log(log, detector, Settings(), Ledger(), cache=tmp_path / "cache")
        camera = replace(log.cameras[0].camera, height=480)
        with pytest.raises(LogError, match="camera's size"):
            detect_log(with_camera(log, camera=camera), detector, Settings(), Ledger(), cache=tmp_path / "cache")

    @pytest.mark.parametrize("harm", ["cut", "bit", "garbage", "swapped", "empty line"])
    def test_damaged_lines_are_passed_over_and_counted(self, log, detector, tmp_path, seen, harm):
        first = detect_log(log, detector, Settings(), Ledger(), cache=tmp_path / "cache")
        (file,) = (tmp_path / "cache").iterdir()
        lines = file.read_bytes().splitlines(keepends=True)
        if harm == "cut":  # killed while it wrote
            lines[-1] = lines[-1][:50]
        elif harm == "bit":
            lines[2] = lines[2].replace(b"0.", b"1.", 1) if b"0." in lines[2] else lines[2][:-3] + b"x\n"
        elif harm == "garbage":
            lines[2] = b"\xff\x00 garbage \xfe\n"
        elif harm == "swapped":
            lines[2] = lines[1][:9] + lines[2][9:]
        else:
            lines.insert(2, b"\n")
        file.write_bytes(b"".join(lines))
        ledger = Ledger()
        again = detect_log(log, detector, Settings(), ledger, cache=tmp_path / "cache")
        damaged = harm != "empty line"
        assert len(seen) == FRAMES + damaged
        assert ledger.dropped == ({"damaged line of the detection cache": 1} if damaged else {})
        same(first.cameras[0].detections, again.cameras[0].detections)
        detect_log(log, detector, Settings(), Ledger(), cache=tmp_path / "cache")
        assert len(seen) == FRAMES + damaged  # it has been mended

    def test_a_run_that_failed_keeps_what_it_had(self, log, detector, tmp_path, seen, monkeypatch):
        run, calls = Detector.detect, []

        def fails(self, images):
            calls.extend(images)
            if len(calls) > 4:
                raise DetectorError("out of memory")
            return run(self, images)

        monkeypatch.setattr(Detector, "detect", fails)
        with pytest.raises(DetectorError, match="out of memory"):
            detect_log(log, detector, Settings(), Ledger(), cache=tmp_path / "cache")
        monkeypatch.setattr(Detector, "detect", run)
        found = detect_log(log, detector, Settings(), Ledger(), cache=tmp_path / "cache")
        assert len(seen) == FRAMES  # four before it failed, the other three after
        same(found.cameras[0].detections, detect_log(log, detector, Settings(), Ledger()).cameras[0].detections)

    def test_a_place_that_cannot_be_written_is_told_once(self, log, detector, tmp_path):
        (tmp_path / "file").write_text("")
        ledger = Ledger()
        found = detect_log(log, detector, Settings(), ledger, cache=tmp_path / "file")
        assert len(found.cameras[0].detections.frame_stamps) == FRAMES
        (warning,) = ledger.warnings
        assert "the detection cache cannot be used" in warning

    def test_a_full_disk_is_told_once(self, log, detector, tmp_path, monkeypatch):
        write = os.write
        monkeypatch.setattr(os, "write", lambda handle, data: write(handle, data[:20]))
        ledger = Ledger()
        found = detect_log(log, detector, Settings(), ledger, cache=tmp_path / "cache")
        assert len(found.cameras[0].detections.frame_stamps) == FRAMES
        (warning,) = ledger.warnings
        assert "No space left on device" in warning
        monkeypatch.undo()
        ledger = Ledger()
        detect_log(log, detector, Settings(), ledger, cache=tmp_path / "cache")
        assert ledger.dropped == {"damaged line of the detection cache": 1}

    def test_lines_are_json_behind_a_checksum(self, log, detector, tmp_path):
        found = detect_log(log, detector, Settings(), Ledger(), cache=tmp_path / "cache").cameras[0].detections
        (file,) = (tmp_path / "cache").iterdir()
        entries = [json.loads(line[9:]) for line in file.read_text().splitlines()]
        assert [len(entry["boxes"]) for entry in entries] == np.bincount(found.frame, minlength=FRAMES).tolist()
        assert entries[0]["size"] == [WIDTH, HEIGHT]

    def test_the_users_folder(self, monkeypatch):
        monkeypatch.setenv("XDG_CACHE_HOME", "/somewhere")
        assert default_cache() == Path("/somewhere/objslam/detections")
        monkeypatch.setenv("HOME", "/home/me")
        for unset in ("", "relative"):
            monkeypatch.setenv("XDG_CACHE_HOME", unset)
            assert default_cache() == Path("/home/me/.cache/objslam/detections")


def test_boxes_get_their_depth(log, detector, tmp_path):
    files = []
    for i in range(FRAMES):
        depth = np.full((HEIGHT, WIDTH), 4000, np.uint16)
        for k, (x1, y1, x2, y2) in enumerate(truth(i)):
            depth[y1:y2, x1:x2] = 1000 * (k + 1) + i
        files.append(tmp_path / f"depth{i}.png")
        cv2.imwrite(str(files[-1]), depth)
    log = with_camera(log, depth=Images(log.cameras[0].rgb.stamps + 0.005, tuple(files)))
    detections = detect_log(log, detector, Settings(), Ledger()).cameras[0].detections
    expected = 1.0 + (detections.label == detections.label_names.index("green")) + 1e-3 * detections.frame
    np.testing.assert_allclose(detections.depths, expected)
    settings = Settings.model_validate({"depth": {"use": False}})
    assert np.isnan(detect_log(log, detector, settings, Ledger()).cameras[0].detections.depths).all()


def test_other_cameras_and_detections_that_were_there(log, detector):
    mapped = detect_log(log, detector, Settings(), Ledger()).cameras[0]
    blind = replace(mapped, rgb=None, camera=replace(mapped.camera, name="rear"))
    ledger = Ledger()
    both = detect_log(replace(log, cameras=(mapped, blind)), detector, Settings(), ledger)
    same(both.cameras[0].detections, mapped.detections)
    assert both.cameras[1] is blind
    assert ledger.warnings == ["camera front: the boxes of the detector replace the boxes of the log"]


def test_a_detector_that_finds_nothing_is_told(log, tmp_path):
    ledger = Ledger()
    detections = detect_log(log, load(tmp_path, min_score=0.95), Settings(), ledger).cameras[0].detections
    assert (len(detections), len(detections.frame_stamps)) == (0, FRAMES)
    assert "found nothing in 7 images" in ledger.warnings[0]


def test_what_is_odd_about_the_model_is_told(log, tmp_path):
    ledger = Ledger()
    detect_log(log, load(tmp_path, {"stride": "32"}), Settings(), ledger)
    assert "names no classes" in ledger.warnings[0]


class TestAhead:
    def test_keeps_the_order_and_its_distance(self):
        taken, done = [], []

        def items():
            for i in range(40):
                taken.append(i)
                yield i

        ended = [threading.Event() for _ in range(40)]

        def work(i):
            if i % 3 == 0 and i + 1 < 40:
                assert ended[i + 1].wait(LIMIT)  # the next one is done before
            ended[i].set()
            return i

        for result in ahead(work, items(), 5):
            done.append(result)
            assert len(taken) <= len(done) + 5
        assert done == list(range(40))

    def test_raises_what_the_work_raises(self):
        def work(i):
            if i == 3:
                raise ValueError("three")
            return i

        results = ahead(work, range(10), 2)
        assert [next(results) for _ in range(3)] == [0, 1, 2]
        with pytest.raises(ValueError, match="three"):
            next(results)

    def test_leaves_no_thread_behind(self):
        before = set(threading.enumerate())
        results = ahead(lambda i: i, range(1000), 4)
        next(results)
        assert set(threading.enumerate()) > before
        results.close()
        assert set(threading.enumerate()) <= before
