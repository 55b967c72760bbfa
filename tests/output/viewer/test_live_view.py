"""A session looked at while it goes on: what arrives, and that nobody waits for a viewer."""

from __future__ import annotations

import dataclasses
import io
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest
from rrd import Recording, rgb
from synthetic_result import clusters, synthetic_result
from waiting import LIMIT, wait_for

from objslam.core.camera import Camera
from objslam.core.object_map import ObjectMap
from objslam.core.result import RunResult
from objslam.core.snapshot import CameraFrame, Snapshot
from objslam.core.trajectory import Trajectory
from objslam.core.types import CameraLog, Images, Log
from objslam.errors import ConfigError, OutputError
from objslam.output.viewer import application
from objslam.output.viewer.images import of_log
from objslam.output.viewer.live.live_view import LiveView
from objslam.output.viewer.live.wire import encode_snapshot, read_snapshot


def snapshots(result: RunResult, count: int) -> list[Snapshot]:
    """A drive as a session shows it: keyframes and objects come one after the other, the fourth is dropped in the end."""
    found = []
    for k in range(1, count + 1):
        n = len(result.keyframes) * k // count
        objects = tuple(o for i, o in enumerate(result.map.objects[: 4 * k]) if i != 3 or k < count)
        path = Trajectory(result.keyframes.stamps[:n], result.map_T_base[:n])
        dropped = {"boxes cut off": k}
        found.append(
            Snapshot(float(path.stamps[-1]), ObjectMap(objects), path, n, 0, 0.01 * k, (0.002, 0.02), {"frames": n}, dropped)
        )
    return found


def frame(result: RunResult, keyframe: int) -> CameraFrame:
    mine = result.rays.keyframe == keyframe
    index = result.association.object[mine]
    ids = np.array([o.id for o in result.map.objects])
    return CameraFrame(
        stamp=float(result.keyframes.stamps[keyframe]),
        camera=result.cameras[0],
        map_T_camera=(result.map_T_base @ result.keyframes.base_T_camera)[keyframe],
        boxes=result.rays.box[mine],
        objects=np.where(index >= 0, ids[index], -1),
        rejected=(index >= 0) & (result.weight[mine] < 0.5),
        image=np.full((480, 640, 3), (10, 20, 200), dtype=np.uint8),
    )


@pytest.fixture(scope="module")
def result() -> RunResult:
    return synthetic_result(*clusters(), keyframes=40, unresolved=(2,))[0]


def test_a_message_comes_through_whole(result: RunResult) -> None:
    snapshot = dataclasses.replace(snapshots(result, 4)[-1], frames=(frame(result, 7),))
    nothing = Snapshot(np.nan, ObjectMap(()), Trajectory(np.zeros(0), np.zeros((0, 4, 4))))
    stream = io.BytesIO(encode_snapshot(snapshot, 5) + encode_snapshot(nothing))
    first, second = read_snapshot(stream), read_snapshot(stream)
    assert read_snapshot(stream) is None
    assert first is not None
    assert second is not None
    shown, (got,) = first
    assert [o.label for o in shown.map.objects] == [o.label for o in snapshot.map.objects]
    np.testing.assert_allclose(shown.path, result.map_T_base[:, :3, 3], atol=1e-4)
    np.testing.assert_array_equal(shown.base, result.map_T_base[-1])
    assert shown.numbers["unseen"] == 5
    assert shown.dropped == {"boxes cut off": 4}
    sent = frame(result, 7)
    for name in ("map_T_camera", "boxes", "objects", "rejected"):
        np.testing.assert_array_equal(getattr(got, name), getattr(sent, name))
    assert isinstance(got.image, bytes)
    np.testing.assert_allclose(cv2.imdecode(np.frombuffer(got.image, np.uint8), 1)[5, 5], (10, 20, 200), atol=4)
    assert np.isnan(second[0].stamp)
    assert second[0].base is None
    cut = encode_snapshot(snapshot)[:-10]
    assert read_snapshot(io.BytesIO(cut)) is None
    assert read_snapshot(io.BytesIO(cut[:300])) is None


def test_frames_get_their_images_where_they_are_found(result: RunResult, tmp_path: Path) -> None:
    """A snapshot has no images. The view asks for each by the name of the camera and the stamp."""
    bare = dataclasses.replace(frame(result, 7), image=None)
    snapshot = dataclasses.replace(snapshots(result, 4)[-1], frames=(bare,))
    images = {("front", bare.stamp): np.full((480, 640, 3), (200, 20, 10), dtype=np.uint8)}
    for name, find in (("with", lambda *asked: images.get(asked)), ("without", lambda *_: None)):
        with LiveView(file=tmp_path / f"{name}.rrd", image=find) as view:
            view.show(snapshot)
            wait_for(lambda view=view: view.shown)
    r = Recording(tmp_path / "with.rrd")
    blob = bytes(np.array(r.get("/map/camera/front/image", "EncodedImage:blob")[-1][0], dtype=np.uint8))
    np.testing.assert_allclose(cv2.imdecode(np.frombuffer(blob, np.uint8), 1)[5, 5], (200, 20, 10), atol=4)
    assert "/map/camera/front/image" not in Recording(tmp_path / "without.rrd").paths()
    assert len(Recording(tmp_path / "without.rrd").get("/map/camera/front/boxes", "Boxes2D:half_sizes")[-1])


def test_the_image_of_a_log_at_a_stamp(tmp_path: Path) -> None:
    paths = []
    for i in range(3):
        paths.append(tmp_path / f"{i}.png")
        cv2.imwrite(str(paths[-1]), np.full((4, 6, 3), 10 * i, dtype=np.uint8))
    paths[2].write_bytes(b"no image")
    front = Camera("front", 6, 4, np.eye(3))
    log = Log("log", (CameraLog(front, rgb=Images(np.array([1.0, 1.1, 1.2]), tuple(paths))),))
    find = of_log(log)
    near, next_one = find("front", 1.02), find("front", 1.09)
    assert near is not None and next_one is not None  # noqa: PT018
    assert (near[0, 0, 0], next_one[0, 0, 0]) == (0, 10)
    assert find("front", 1.2) is None  # damaged
    assert find("front", 5.0) is None
    assert find("rear", 1.0) is None


def test_a_session_becomes_a_recording(result: RunResult, tmp_path: Path) -> None:
    every = snapshots(result, 4)
    with LiveView(file=tmp_path / "live.rrd") as view:
        for k, snapshot in enumerate(every):
            view.show(dataclasses.replace(snapshot, frames=(frame(result, 10 * k + 9),)))
            wait_for(lambda k=k: view.shown > k)
        view.close(LIMIT)
    assert (view.shown, view.dropped) == (4, 0)
    r = Recording(tmp_path / "live.rrd")
    subprocess.run(
        [application.program(), "rrd", "verify", tmp_path / "live.rrd"], check=True, capture_output=True, timeout=LIMIT
    )
    resolved = [[o for o in s.map.objects if o.status == "ok"] for s in every]
    points = r.get("/map/objects", "Points3D:positions")
    assert [len(row) for row in points] == [len(some) for some in resolved]
    np.testing.assert_allclose(points[-1], [o.position for o in resolved[-1]], rtol=1e-5)
    strips = r.get("/map/path/after", "LineStrips3D:strips")
    assert [len(row[0]) for row in strips] == [10, 20, 30, 40]
    assert [row[0] for row in r.get("/plots/live/lag/now", "Scalars:scalars")] == pytest.approx([10, 20, 30, 40])
    assert [row[0] for row in r.get("/plots/live/lag/p99", "Scalars:scalars")] == pytest.approx([20] * 4)
    assert [row[0] for row in r.get("/plots/live/dropped/messages", "Scalars:scalars")] == [1, 2, 3, 4]
    text = [row[0] for row in r.get("/log", "TextLog:text")]
    assert sum(t.startswith("new: ") for t in text) == 15
    assert sum(t.startswith("resolved: ") for t in text) == 14
    gone = result.map.objects[3]
    assert [t for t in text if t.startswith("dropped: ")] == [
        f"dropped: {gone.label} #{gone.id}, {gone.rays} rays, its rays are now unexplained"
    ]
    assert "dropped: boxes cut off | 4" in r.get("/summary", "TextDocument:text")[-1][0]
    # the last frame's boxes, in the colours that they have offline
    colours = [rgb(c) for c in r.get("/map/camera/front/boxes", "Boxes2D:colors")[-1]]
    sent = frame(result, 39)
    known = np.isin(sent.objects, [o.id for o in every[-1].map.objects])
    for (red, green, blue), rejected, held in zip(colours, sent.rejected, known, strict=True):
        grey = red == green == blue
        assert (red > 2 * green and red > 2 * blue) if rejected else grey != held
    assert [len(row) for row in r.get("/map/camera/front/image", "EncodedImage:blob")] == [1] * 4
    rays = np.array(r.get("/map/rays/now", "LineStrips3D:strips")[-1])
    np.testing.assert_allclose(rays[:, 0], np.broadcast_to(sent.map_T_camera[:3, 3], (15, 3)), rtol=1e-5)


@pytest.fixture
def viewer() -> Iterator[tuple[subprocess.Popen[bytes], int]]:
    """A viewer's server, without the viewer: nothing is drawn."""
    port = application.free_port()
    process = application.start_listening(port, "--serve-grpc", "--port", str(port))
    try:
        yield process, port
    finally:
        process.kill()
        process.wait()


def heavy(result: RunResult) -> tuple[Snapshot, Snapshot]:
    """A snapshot, and the same with more images than a socket has room for."""
    noise = np.random.default_rng(0).integers(0, 255, (480, 640, 3), dtype=np.uint8)
    picture = cv2.imencode(".jpg", noise)[1].tobytes()
    snapshot = snapshots(result, 4)[-1]
    many = tuple(dataclasses.replace(frame(result, k), image=picture) for k in range(40))
    return snapshot, dataclasses.replace(snapshot, frames=many)


@pytest.mark.parametrize("how", ["frozen", "killed"])
def test_a_viewer_that_hangs_or_dies_keeps_nobody_waiting(
    result: RunResult, viewer: tuple[subprocess.Popen[bytes], int], how: str
) -> None:
    process, port = viewer
    snapshot, large = heavy(result)
    view = LiveView(address=application.address(port))
    view.show(snapshot)
    wait_for(lambda: view.shown == 1)
    if how == "frozen":
        process.send_signal(signal.SIGSTOP)
    else:
        process.kill()
        process.wait()
    number = 40
    for _ in range(number):  # a call that waited for the viewer would never come back
        view.show(large)
    view.close(1.0)
    assert view.shown + view.dropped == number + 1
    assert view.dropped > number / 2
    if how == "frozen":
        process.send_signal(signal.SIGCONT)


def test_a_viewer_that_comes_back_is_found(result: RunResult, viewer: tuple[subprocess.Popen[bytes], int]) -> None:
    process, port = viewer
    snapshot = snapshots(result, 4)[-1]
    with LiveView(address=application.address(port)) as view:
        view.show(snapshot)
        wait_for(lambda: view.shown == 1)
        process.kill()
        process.wait()
        view.show(snapshot)
        wait_for(lambda: view.dropped == 1)
        again = application.start_listening(port, "--serve-grpc", "--port", str(port))
        try:
            wait_for(lambda: view.show(snapshot) and view.shown >= 2, 0.3)
        finally:
            again.kill()
            again.wait()


def test_a_process_ends_however_its_viewer_is(viewer: tuple[subprocess.Popen[bytes], int]) -> None:
    """The process ends without `close`, while its viewer is stopped."""
    process, port = viewer
    script = (
        "import os, signal, sys, time\n"
        "import numpy as np\n"
        "from objslam.core.object_map import ObjectMap\n"
        "from objslam.core.snapshot import CameraFrame, Snapshot\n"
        "from objslam.core.types import Camera, Trajectory\n"
        "from objslam.output.viewer.live.live_view import LiveView\n"
        "from dataclasses import replace\n"
        "snapshot = Snapshot(1.0, ObjectMap(()), Trajectory(np.zeros(1), np.eye(4)[None]))\n"
        "none = np.zeros(0, dtype=np.int64)\n"
        "camera = Camera('front', 640, 480, np.eye(3))\n"
        "frame = CameraFrame(1.0, camera, np.eye(4), np.zeros((0, 4)), none, none.astype(bool), os.urandom(5_000_000))\n"
        "view = LiveView(address=sys.argv[1])\n"
        "view.show(snapshot)\n"
        "while not view.shown: time.sleep(0.02)\n"
        "os.kill(int(sys.argv[2]), signal.SIGSTOP)\n"
        "for _ in range(10): view.show(replace(snapshot, frames=(frame, frame)))\n"
        "time.sleep(0.5)\n"
        "print(view._process.pid, view.shown, flush=True)\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", script, application.address(port), str(process.pid)],
        timeout=LIMIT,
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    logger, shown = done.stdout.split()
    assert shown == "1"  # the viewer was stopped after one snapshot
    wait_for(lambda: not Path(f"/proc/{logger}").exists())
    process.send_signal(signal.SIGCONT)


def test_what_cannot_be_shown_to_is_said(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="no address"):
        LiveView(address="127.0.0.1:9876")
    with pytest.raises(OutputError, match="No such file"):
        LiveView(file=tmp_path / "none" / "a.rrd")
