"""The process that logs the snapshots of a session to a viewer or a file.

If a viewer hangs, rerun's connection blocks, and the process with this connection cannot end. The connection is therefore in
a separate process, which the session can kill.

Start: `python -m objslam.output.viewer.live.live_process [--file FILE] [--address URL]`. The process reads messages from
stdin. It answers each message with a line: "ok" if the viewer or the file has received the message, "lost" if this is not
certain.
"""

import argparse
import os
import sys
import threading
import time
from typing import Any

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from objslam.core.arrays import Floats, Ints
from objslam.core.camera import undistort
from objslam.core.geometry import quaternion
from objslam.core.object_map import ObjectMap
from objslam.core.snapshot import CameraFrame
from objslam.core.validity import is_date
from objslam.io.threads import start_thread
from objslam.output.viewer.blueprint import blueprint
from objslam.output.viewer.cameras import camera_path, light_colours, log_pinhole
from objslam.output.viewer.event_log import map_changes, table
from objslam.output.viewer.live.wire import ShownSnapshot, read_snapshot
from objslam.output.viewer.objects import log_objects
from objslam.output.viewer.rays import RAY_COLOURS
from objslam.output.viewer.times import STAMP
from objslam.output.viewer.view_point import ViewPoint, first_view_point

_GRACE = 5.0  # The time, s, after the end of the session in which a viewer can receive the last message.
_RETRY = 2.0  # The least time, s, between two attempts to reach a lost viewer.
_PATH = (40, 44, 52)  # The colour of the path (RGB): nearly black.
_FREE_REACH = 2.0  # The drawn length, m, of a ray without an object.


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--file")
    parser.add_argument("--address")
    options = parser.parse_args()
    parent = os.getppid()
    recording = rr.RecordingStream("objslam")
    _connect(recording, options)
    log, tried, lost = LiveLog(recording), time.monotonic(), False
    while (message := read_snapshot(sys.stdin.buffer)) is not None:
        if lost and time.monotonic() - tried > _RETRY:
            _connect(recording, options)
            log.begin()
            tried = time.monotonic()
        log.show(*message)
        lost = not _delivered(recording, parent)
        sys.stdout.write("lost\n" if lost else "ok\n")
        sys.stdout.flush()
    timer = threading.Timer(_GRACE, lambda: os._exit(1))  # A hanging viewer would block `disconnect` for ever.
    timer.daemon = True
    start_thread(timer)
    recording.disconnect()


def _connect(recording: Any, options: argparse.Namespace) -> None:
    chosen = ((rr.FileSink, options.file), (rr.GrpcSink, options.address))
    recording.set_sinks(*(sink(target) for sink, target in chosen if target is not None))


def _delivered(recording: Any, parent: int) -> bool:
    """Wait until the logged data have arrived, and return True. Return False if the data are lost.

    The process exits if the session ends during this time. parent: the process id of the session.
    """
    while True:
        try:
            recording.flush(timeout_sec=1.0)
            return True
        except RuntimeError as error:
            if "timed out" not in str(error):
                return False
        if os.getppid() != parent:
            os._exit(1)


class LiveLog:
    """A logger that adds snapshots to a recording. Only one thread may use it."""

    def __init__(self, recording: Any) -> None:
        self._recording = recording
        self._map = ObjectMap(())
        self._cameras: dict[str, str] = {}
        self._view_point: ViewPoint | None = None
        self.begin()

    def begin(self) -> None:
        """Log the static data, which a restarted viewer needs again."""
        self._recording.log("map", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
        self._recording.log("map/base", rr.TransformAxes3D(0.3), static=True)
        self._cameras.clear()
        self._view_point = None

    def show(self, shown: ShownSnapshot, frames: list[CameraFrame]) -> None:
        """Log a snapshot and its camera frames."""
        view_point = self._look(shown, frames)
        for frame in sorted(frames, key=lambda f: f.stamp):
            self._at(frame.stamp)
            self._frame(frame, shown.map)
        if np.isfinite(shown.stamp):
            self._at(shown.stamp)
            self._snapshot(shown, view_point)

    def _at(self, stamp: float) -> None:
        self._recording.set_time(STAMP, **{"timestamp" if is_date(stamp) else "duration": stamp})

    def _look(self, shown: ShownSnapshot, frames: list[CameraFrame]) -> ViewPoint:
        """Return the view point. Send a new layout if there is a new camera, or if the map outgrows the old view."""
        view_point, before = first_view_point(shown.map, shown.path), self._view_point
        places = np.concatenate([np.array([o.position for o in shown.map.objects]).reshape(-1, 3), shown.path])
        new = [f.camera for f in frames if f.camera.name not in self._cameras]
        for camera in new:
            self._cameras[camera.name] = camera_path(camera)
            log_pinhole(self._recording, self._cameras[camera.name], camera, 1.0, view_point.distance)
        if before is None or new or (view_point.has_in_view(places) & ~before.has_in_view(places)).any():
            layout = blueprint(view_point, [(path, name) for name, path in self._cameras.items()], live=True)
            self._recording.send_blueprint(layout)
            self._view_point = before = view_point
        return before

    def _snapshot(self, shown: ShownSnapshot, view_point: ViewPoint) -> None:
        recording = self._recording
        recording.log("map/path/after", rr.LineStrips3D([shown.path], colors=[_PATH], radii=rr.Radius.ui_points(2)))
        log_objects(recording, shown.map, view_point, shown.path, static=False)
        if shown.base is not None:
            recording.log("map/base", _transform(shown.base))
        n, resolved = shown.numbers, len(shown.map.resolved())
        curves = {"lag/now": 1e3 * n["lag"], "lag/p50": 1e3 * n["p50"], "lag/p99": 1e3 * n["p99"]}
        curves |= {"objects/resolved": resolved, "objects/unresolved": len(shown.map) - resolved}
        curves |= {"dropped/messages": sum(shown.dropped.values()), "dropped/snapshots": n["unseen"]}
        for name, value in curves.items():
            recording.log(f"plots/live/{name}", rr.Scalars(value))
        for level, text in map_changes(self._map, shown.map):
            recording.log("log", rr.TextLog(text, level=level))
        self._map = shown.map
        recording.log("summary", rr.TextDocument(_counters(shown), media_type="text/markdown"), static=True)

    def _frame(self, frame: CameraFrame, objects: ObjectMap) -> None:
        recording, path = self._recording, self._cameras[frame.camera.name]
        recording.log(path, _transform(frame.map_T_camera))
        if isinstance(frame.image, bytes):
            recording.log(f"{path}/image", rr.EncodedImage(contents=frame.image, media_type="image/jpeg"))
        place = {o.id: i for i, o in enumerate(objects.objects)}
        index = np.array([place.get(j, -1) for j in frame.objects.tolist()], dtype=np.int64)
        used = (index >= 0) & ~frame.rejected
        colour = np.where(frame.rejected[:, None], RAY_COLOURS["rejected"], RAY_COLOURS["unexplained"])
        ray_colour = np.where(used[:, None], RAY_COLOURS["used"], colour)
        colour[used] = light_colours(objects)[index[used]]
        radius, corners = rr.Radius.ui_points(1.5), rr.Box2DFormat.XYXY
        boxes = rr.Boxes2D(array=frame.boxes, array_format=corners, colors=colour.astype(np.uint8), radii=radius)
        recording.log(f"{path}/boxes", boxes)
        rays = _rays(frame, objects, index)
        recording.log("map/rays/now", rr.LineStrips3D(rays, colors=ray_colour.astype(np.uint8), radii=radius))


def _transform(pose: Floats) -> rr.Transform3D:
    return rr.Transform3D(translation=pose[:3, 3], quaternion=rr.Quaternion(xyzw=quaternion(pose)))


def _rays(frame: CameraFrame, objects: ObjectMap, index: Ints) -> NDArray[np.float32]:
    """Return the rays of the boxes as lines (B, 2, 3) in map, m. index: (B,) index of the object of each box, or -1.

    A ray starts at the camera and is as long as the distance to its object, or `_FREE_REACH` long without an object.
    """
    directions, _ = undistort(frame.camera, (frame.boxes[:, :2] + frame.boxes[:, 2:]) / 2)
    origin = frame.map_T_camera[:3, 3]
    ahead = directions @ frame.map_T_camera[:3, :3].T
    reach = np.full(len(ahead), _FREE_REACH)
    held = index >= 0
    positions = np.array([o.position for o in objects.objects]).reshape(-1, 3)[index[held]]
    distance = np.linalg.norm(positions - origin, axis=1)
    reach[held] = np.where(np.isfinite(distance), distance, _FREE_REACH)
    return np.stack([np.broadcast_to(origin, ahead.shape), origin + reach[:, None] * ahead], axis=1).astype(np.float32)


def _counters(shown: ShownSnapshot) -> str:
    rows = [(name, f"{value:g}") for name, value in shown.numbers.items() if name in ("keyframes", "rebuilds")]
    rows += [(name, str(value)) for name, value in shown.counters.items()]
    rows += [(f"dropped: {name}", str(value)) for name, value in shown.dropped.items()]
    if shown.numbers["unseen"]:
        rows.append(("snapshots that the viewer missed", f"{shown.numbers['unseen']:g}"))
    return "\n".join(table(rows))


if __name__ == "__main__":
    main()
