"""JSON lines on a pipe, good and bad."""

import io
import json
import os
import threading

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from robot import BASE_T_CAMERA, MATRIX, Recorder
from scipy.spatial.transform import Rotation
from waiting import LIMIT

from objslam.config import load_settings
from objslam.core.diagnostics import Ledger
from objslam.io.detections_jsonl import read_detections
from objslam.live.adapters.replay import ReplayAdapter
from objslam.live.adapters.stdin import StdinAdapter
from objslam.live.session.session import Session
from objslam.sources import read

POSE = {"translation": [1.0, 2.0, 0.5], "rotation_xyzw": [0.0, 0.0, float(np.sin(0.2)), float(np.cos(0.2))]}
CAMERA = {
    "type": "camera",
    "name": "front",
    "image_width": 640,
    "image_height": 480,
    "camera_matrix": MATRIX,
    "distortion_model": "plumb_bob",
    "distortion_coefficients": [1e-05, 0, 0, 0, 0],
    "base_T_camera": {
        "translation": BASE_T_CAMERA[:3, 3].tolist(),
        "rotation_xyzw": Rotation.from_matrix(BASE_T_CAMERA[:3, :3]).as_quat().tolist(),
    },
}
BOXES = {"boxes": [[1, 2, 3, 4], [5, 6, 9, 9]], "labels": ["cup", "mug"], "scores": [0.5, 1]}


def feed(data: bytes):
    """What is pushed, and the adapter, for bytes on a pipe."""
    adapter = hear(data, Recorder())
    return adapter.sink, adapter


def hear(data: bytes, sink):
    """The adapter that pushed what the bytes on a pipe say into a sink."""
    reading, writing = os.pipe()
    threading.Thread(target=_write, args=(writing, data), daemon=True).start()
    with os.fdopen(reading, "rb") as stream:
        adapter = StdinAdapter(sink, stream)
        adapter.run(threading.Event())
    return adapter


def _write(writing, data):
    with os.fdopen(writing, "wb") as pipe:
        pipe.write(data)


def lines(*messages):
    return b"".join(json.dumps(message).encode() + b"\n" for message in messages)


@pytest.mark.parametrize(
    ("second", "wait", "advice"),
    [
        (0.125, None, "the messages came 8 times as fast as their stamps: with --speed 0"),
        (1.0, None, ""),  # a running robot
        (0.125, lambda: None, ""),  # no frame is dropped
    ],
)
def test_a_recording_in_a_pipe_is_told_from_a_robot(second, wait, advice):
    """second: the time in s that passes for each second of the stamps."""
    now = iter([0.0, *(second * np.arange(20))])
    reading, writing = os.pipe()
    poses = lines(*({"type": "odometry", "stamp": 1e9 + i, **POSE} for i in range(20)))
    threading.Thread(target=_write, args=(writing, poses), daemon=True).start()
    with os.fdopen(reading, "rb") as stream:
        adapter = StdinAdapter(Recorder(), stream, wait=wait, clock=lambda: next(now))
        assert adapter.late() == ""
        adapter.run(threading.Event())
    assert adapter.late().startswith(advice)
    assert bool(adapter.late()) == bool(advice)


def test_every_kind_of_message():
    sink, adapter = feed(
        lines(
            CAMERA,
            {"type": "odometry", "stamp": 1, **POSE, "covariance": list(range(36))},
            {"type": "odometry", "stamp": 1.5, "x": 1, "y": 2, "yaw": 0.4},
            {"type": "localization", "stamp": 1.5, **POSE},
            {"type": "mount", "camera": "front", "stamp": 1.6, **POSE},
            {"type": "detections", "camera": "front", "stamp": 1.7, **BOXES, "depths": [None, 2.5], "track_ids": [3, None]},
        )
        + lines({"type": "detections", "stamp": 1.8, "boxes": [], "labels": [], "scores": []}).rstrip(b"\n")
    )
    (camera,) = sink.cameras
    assert (camera.name, camera.width, camera.distortion[0]) == ("front", 640, 1e-5)
    np.testing.assert_allclose(camera.base_T_camera, BASE_T_CAMERA, atol=1e-12)
    expected = np.eye(4)
    expected[:3, :3] = Rotation.from_euler("z", 0.4).as_matrix()
    expected[:3, 3] = [1, 2, 0.5]
    (a, first, covariance, _), (b, second, nothing, _) = sink.odometry
    assert (a, b) == (1, 1.5)
    np.testing.assert_allclose(first, expected, atol=1e-12)
    np.testing.assert_array_equal(covariance, np.arange(36).reshape(6, 6))
    assert nothing is None
    expected[2, 3] = 0
    np.testing.assert_allclose(second, expected, atol=1e-12)
    assert sink.localization[0][0] == 1.5
    assert sink.mounts[0][:2] == (1.6, "front")
    stamp, name, boxes, labels, scores, tracks, _ = sink.detections[0]
    assert (stamp, name, labels, tracks) == (1.7, "front", ["cup", "mug"], [3, -1])
    np.testing.assert_array_equal(boxes, BOXES["boxes"])
    np.testing.assert_array_equal(scores, [0.5, 1])
    assert sink.detections[1][:2] == (1.8, "camera")
    assert not adapter.ledger.dropped


def test_boxes_that_no_edge_cuts_off_say_so():
    sink, adapter = feed(
        lines(
            {"type": "detections", "stamp": 1, **BOXES, "whole": True},
            {"type": "detections", "stamp": 2, **BOXES, "whole": False},
            {"type": "detections", "stamp": 3, **BOXES},
            {"type": "detections", "stamp": 4, **BOXES, "whole": 1},
        )
    )
    assert [stamp for stamp, *_ in sink.detections] == [1, 2, 3]
    assert sink.whole == [True, False, False]
    assert adapter.ledger.dropped == {"line malformed: whole is neither true nor false": 1}


def test_boxes_that_no_edge_cuts_off_are_used_from_stdin_as_from_a_file(tmp_path):
    """The same lines: heard by a session, replayed from its journal, and read as detections.jsonl."""
    edge = "boxes cut off by the image's edge (rays.border, rays.border_share)"
    config = load_settings(None, ("mode=joint", "live.keyframe_distance=0"))
    frames = [{"stamp": 1 + i, "boxes": [[0, 200, 40 + i, 240]], "labels": ["tag"], "scores": [1]} for i in range(4)]
    for whole in (False, True):
        told = [{**frame, "whole": True} for frame in frames] if whole else frames
        poses = [{"type": "odometry", "stamp": 1 + i, "x": 0.1 * i, "y": 0, "yaw": 0} for i in range(5)]
        detections = [{"type": "detections", "camera": "front", **frame} for frame in told]
        out = tmp_path / str(whole)
        out.mkdir()
        (out / "detections.jsonl").write_bytes(lines(*told))
        heard = Session(config, out / "journal.objslam", patient=True).start()
        hear(lines(CAMERA, poses[0], *(m for pair in zip(detections, poses[1:], strict=True) for m in pair)), heard)
        kept = read(out, Ledger())
        again = Session(config, patient=True).start()
        ReplayAdapter(again, kept, None, again.wait).run(threading.Event())
        for session in (heard, again):
            assert session.wait(LIMIT)
            session.abort()
            assert session.counters.dropped() == ({} if whole else {edge: 4})
        assert kept.cameras[0].detections.whole == read_detections(out / "detections.jsonl", Ledger()).whole == whole


@pytest.mark.parametrize(
    ("line", "reason"),
    [
        (b"{", "not JSON"),
        (b"[1]", "not a JSON object"),
        (b"\xff\xfe", "not JSON"),
        (b'{"stamp": 1}', "type is none of"),
        (b'{"type": "odometry", "stamp": 1, "x": 1, "y": 2, "yaw": NaN}', "3 finite numbers"),
        (b'{"type": "odometry", "stamp": "1", "x": 1, "y": 2, "yaw": 3}', "stamp"),
        (b'{"type": "odometry", "stamp": 1, "translation": [1, 2], "rotation_xyzw": [0, 0, 0, 1]}', "translation"),
        (b'{"type": "odometry", "stamp": 1, "translation": [1, 2, 3], "rotation_xyzw": [0, 0, 0, 2]}', "length 1"),
        (b'{"type": "odometry", "stamp": 1, "x": 1, "y": 2, "yaw": 3, "covariance": [1]}', "36"),
        (b'{"type": "camera", "image_width": 640}', "not a valid camera"),
        (b'{"type": "detections", "stamp": 1, "boxes": [[1, 2, 3]], "labels": ["a"], "scores": [1]}', "4 numbers"),
        (b'{"type": "detections", "camera": 5, "stamp": 1, "boxes": [], "labels": [], "scores": []}', "not a name"),
    ],
)
def test_a_bad_line_is_counted_with_its_number(line, reason):
    good = lines({"type": "odometry", "stamp": 1, "x": 1, "y": 2, "yaw": 0.4})
    sink, adapter = feed(good + b"\n" + line + b"\n" + good)
    assert len(sink.odometry) == 2
    ((name, count),) = adapter.ledger.dropped.items()
    assert count == 1
    assert reason in name
    assert "stdin:3" in adapter.ledger.examples[name][0]


def test_an_endless_line_is_skipped():
    good = lines({"type": "odometry", "stamp": 1, "x": 1, "y": 2, "yaw": 0.4})
    sink, adapter = feed(good + b"x" * (3 << 20) + b"\n" + good + b"{")
    assert len(sink.odometry) == 2
    assert adapter.ledger.examples == {
        "line longer than 1048576 bytes": ["stdin:2"],
        "line malformed: not JSON": ["stdin:4"],
    }


def test_it_stops_while_nothing_comes():
    reading, writing = os.pipe()
    stop = threading.Event()
    with os.fdopen(reading, "rb") as stream:
        thread = threading.Thread(target=StdinAdapter(Recorder(), stream).run, args=(stop,))
        thread.start()
        stop.set()
        thread.join(LIMIT)
        assert not thread.is_alive()
    os.close(writing)


json_values = st.recursive(
    st.none() | st.booleans() | st.floats() | st.integers() | st.text(max_size=5),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=5), inner, max_size=3),
    max_leaves=8,
)
KEYS = ["stamp", "translation", "rotation_xyzw", "yaw", "x", "y", "camera", "boxes", "labels", "scores", "depths", "name"]
KEYS += ["image_width", "image_height", "camera_matrix", "distortion_model", "distortion_coefficients", "base_T_camera"]
messages = st.builds(
    lambda kind, rest: {**rest, "type": kind},
    st.sampled_from(["camera", "odometry", "localization", "mount", "detections", "x"]),
    st.dictionaries(st.sampled_from(KEYS), json_values, max_size=8),
)


@settings(max_examples=150)
@given(st.lists(st.one_of(messages.map(lambda m: json.dumps(m).encode()), st.binary(max_size=30)), max_size=5))
def test_no_bytes_break_it(rows):
    adapter = StdinAdapter(Recorder(), io.BytesIO())
    for number, row in enumerate(rows, 1):
        adapter._take(row, number)
    for _, pose, *_ in adapter.sink.odometry + adapter.sink.localization:
        assert np.isfinite(pose).all()
