"""A run that corrects the clock of a camera moves the stamps of its frames. The log's own stamps come along."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
from small_log import small_log

import objslam
from objslam.core.calibration import Calibration
from objslam.core.types import Log
from objslam.io.calibration_yaml import dump_calibration
from objslam.io.rays_parquet import read_rays
from objslam.io.views_parquet import read_views

LATE = 0.08  # s, by which the stamps of the frames are too early.
QUIET = {"mode": "joint", "noise": {"localization": False}, "output": {"recording": False, "picture": False}}


@pytest.fixture(scope="module")
def log() -> Log:
    given = small_log(frames=200, false=0.0)
    (one,) = given.cameras
    assert one.detections is not None
    early = replace(one.detections, frame_stamps=one.detections.frame_stamps - LATE)
    return replace(given, cameras=(replace(one, detections=early),))


def joined(result: objslam.Result, log: Log) -> None:
    """Each ray has a stamp of the log, and its box is one of the boxes that the log has at this stamp."""
    found, rays = log.cameras[0].detections, result.rays
    assert found is not None
    frame = {stamp: number for number, stamp in enumerate(found.frame_stamps.tolist())}
    for stamp, box in zip(rays.frame_stamp.tolist(), rays.box, strict=True):
        assert (found.boxes[found.frame == frame[stamp]] == box).all(axis=1).any()
    np.testing.assert_allclose(rays.stamp - rays.frame_stamp, LATE, atol=1e-6)


def test_a_result_joins_with_its_log_by_the_stamps_of_the_frames(log: Log, tmp_path: Path) -> None:
    known = Calibration(("left.clock",), np.array([LATE]), 1e-6 * np.eye(1), np.array([0.1]))
    (tmp_path / "robot.yaml").write_text(dump_calibration(known))
    result = objslam.run(log, {**QUIET, "calibration": {"use": False, "file": str(tmp_path / "robot.yaml")}})
    joined(result, log)
    out = tmp_path / "out"
    result.save(out)
    joined(objslam.Result.load(out), log)
    views, found = read_views(out / "views.parquet"), log.cameras[0].detections
    assert found is not None
    assert np.isin(views.frame_stamps, found.frame_stamps).all()
    assert len(views.frame_stamps) > 0.9 * len(found.frame_stamps)
    assert not np.isin(views.stamps, found.frame_stamps).all()
    older = pq.read_table(out / "rays.parquet").drop_columns("frame_stamp")
    pq.write_table(older, tmp_path / "older.parquet")
    np.testing.assert_array_equal(read_rays(tmp_path / "older.parquet").frame_stamp, result.rays.stamp)


def test_the_result_of_a_session_joins_with_what_was_pushed(log: Log) -> None:
    path, found = log.robot_path, log.cameras[0].detections
    assert path is not None
    assert found is not None
    with objslam.Session({"output": QUIET["output"]}, patient=True) as session:
        session.push_camera(log.cameras[0].camera)
        moments = [(stamp, 0, k) for k, stamp in enumerate(path.stamps.tolist())]
        moments += [(stamp, 1, k) for k, stamp in enumerate(found.frame_stamps.tolist())]
        for stamp, what, k in sorted(moments):
            if what == 0:
                session.push_localization(stamp, path.poses[k])
            else:
                seen = found.take(found.frame == k)
                session.push_detections(stamp, "left", seen.boxes, seen.labels, seen.scores)
        session.wait()
        result = session.result()
    rays = result.rays
    assert len(rays) > 100
    assert np.isin(rays.frame_stamp, found.frame_stamps).all()
