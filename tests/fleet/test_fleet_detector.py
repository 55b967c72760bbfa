"""A fleet with a detector: the boxes come from the images of each log."""

from dataclasses import replace

import cv2
import numpy as np
from detection.tiny_models import COLOURS, scene, tiny_model
from fleet.fleet_logs import write_logs
from quick import HELD, NOTHING_DRAWN

import objslam
from objslam.config import Settings, load_settings
from objslam.core.types import Images
from objslam.fleet.driver import run_fleet
from objslam.fleet.engines.local_engine import local_engine
from objslam.fleet.engines.worker import Limits
from objslam.fleet.job import make_job
from objslam.fleet.keys import key_of
from objslam.fleet.logs import Layout, find_logs
from objslam.fleet.tasks import map_task
from objslam.fleet.tasks.map_task import MapTask, map_one
from objslam.sources import SourceOptions
from objslam.sources.log_folder import write_log_folder

STEP = 10
"""The step from one frame with an image to the next."""


def with_images(folder, path):
    """Write a log whose images show its boxes, and which has no boxes."""
    log = objslam.read(path)
    camera = log.cameras[0]
    found = camera.detections
    files = []
    for k in range(0, len(found.frame_stamps), STEP):
        file = folder / f"{path.name}_{k}.png"
        boxes = found.boxes[found.frame == k].astype(int).tolist()
        cv2.imwrite(str(file), scene(boxes, camera.camera.width, camera.camera.height))
        files.append(file)
    images = Images(found.frame_stamps[::STEP], tuple(files))
    write_log_folder(replace(log, cameras=(replace(camera, detections=None, rgb=images),)), folder / "logs" / path.name)


def test_a_fleet_finds_the_boxes_as_a_run_does(tmp_path):
    for path in write_logs(tmp_path / "simulated", range(2), sites=1):
        with_images(tmp_path, path)
    model = tiny_model(tmp_path / "m.onnx", "yolov8", size=(640, 640), batch=None, metadata={"names": list(COLOURS)})
    settings = load_settings(None, (*HELD, *NOTHING_DRAWN))
    job = make_job(str(tmp_path / "out"), settings, SourceOptions(), model, report=False)
    logs = find_logs([str(tmp_path / "logs")], Layout("{log}", "none"))
    found = run_fleet(job, logs, local_engine(1, Limits()))
    assert [one.error for one in found.failures] == []
    assert found.new == 2
    for one in found.mapped:
        hand = objslam.run(objslam.read(one.place.path), settings, detector=model).rays
        mapped = objslam.Result.load(tmp_path / "out" / "results" / one.key).rays
        assert len(mapped) > 20
        np.testing.assert_array_equal(mapped.box, hand.box)
        np.testing.assert_array_equal(mapped.direction, hand.direction)
        assert (tmp_path / "out" / "results" / one.key / "detections.jsonl").is_file()
    other = make_job(str(tmp_path / "out"), settings, SourceOptions(), None, report=False)
    assert other.digest != job.digest
    again = replace(job, store=str(tmp_path / "again"))
    map_task._network.cache_clear()
    for log in logs:
        map_one(MapTask(again, log.path, key_of(log.fingerprint, job.digest)))
    assert map_task._network.cache_info().misses == 1  # A process loads a model once.


def test_new_names_of_classes_are_a_new_job(tmp_path):
    """The content of the file counts, and its path does not. Workers of a remote store get the file through it."""
    one, same = tmp_path / "one.txt", tmp_path / "same.txt"
    one.write_text("cup\nbook\n")
    same.write_text("cup\nbook\n")

    def job(names):
        return make_job(str(tmp_path / "out"), Settings(), SourceOptions(class_names=names), None, report=False)

    before = job(str(one)).digest
    assert job(str(same)).digest == before
    assert job("coco").digest != before
    one.write_text("cup\nvase\n")
    assert job(str(one)).digest != before
    assert dict(job(str(one)).files)["class_names"] == str(one)
