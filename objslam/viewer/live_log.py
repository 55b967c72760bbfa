"""A live session in a recording: every snapshot draws the map anew, at its stamp."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from objslam.geometry import quaternion
from objslam.live.interface import Frame
from objslam.rays import undistort
from objslam.types import Ints, ObjectMap
from objslam.viewer.blueprint import blueprint
from objslam.viewer.cameras import camera_path, lighter, log_pinhole
from objslam.viewer.eye import Eye, first_eye
from objslam.viewer.objects import colours, log_objects
from objslam.viewer.rays import RAY_COLOURS
from objslam.viewer.story import map_changes
from objslam.viewer.times import STAMP, is_date
from objslam.viewer.wire import Shown

_PATH = (40, 44, 52)
_LOST = 2.0  # m; how far a ray is drawn that ends on no object


class LiveLog:
    """Logs to a recording; not to be used from two threads at a time."""

    def __init__(self, recording: Any) -> None:
        import rerun as rr

        self._recording = recording
        self._map = ObjectMap(())
        self._cameras: dict[str, str] = {}
        self._eye: Eye | None = None
        recording.log("map", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
        recording.log("map/base", rr.TransformAxes3D(0.3), static=True)

    def renew(self) -> None:
        """Say again what is said once: the viewer is a new one."""
        import rerun as rr

        self._recording.log("map", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
        self._recording.log("map/base", rr.TransformAxes3D(0.3), static=True)
        self._cameras.clear()
        self._eye = None

    def show(self, shown: Shown, frames: list[Frame]) -> None:
        """Log a snapshot, and the frames that came with it."""
        eye = self._look(shown, frames)
        for frame in sorted(frames, key=lambda f: f.stamp):
            self._at(frame.stamp)
            self._frame(frame, shown.map)
        if np.isfinite(shown.stamp):
            self._at(shown.stamp)
            self._snapshot(shown, eye)

    def _at(self, stamp: float) -> None:
        if is_date(stamp):
            self._recording.set_time(STAMP, timestamp=stamp)
        else:
            self._recording.set_time(STAMP, duration=stamp)

    def _look(self, shown: Shown, frames: list[Frame]) -> Eye:
        """The eye that sees the whole; the layout follows where the map has outgrown it, or there is a new camera."""
        eye = first_eye(shown.map, shown.path)
        size, before = float(np.linalg.norm(eye.position - eye.target)), self._eye
        places = np.concatenate([np.array([o.position for o in shown.map.objects]).reshape(-1, 3), shown.path])
        new = [f.camera for f in frames if f.camera.name not in self._cameras]
        for camera in new:
            self._cameras[camera.name] = camera_path(camera)
            log_pinhole(self._recording, self._cameras[camera.name], camera, 1.0, size)
        if before is None or new or (eye.has_in_view(places) & ~before.has_in_view(places)).any():
            layout = blueprint(eye, [(path, name) for name, path in self._cameras.items()], live=True)
            self._recording.send_blueprint(layout)
            self._eye = before = eye
        return before

    def _snapshot(self, shown: Shown, eye: Eye) -> None:
        import rerun as rr

        recording = self._recording
        line = rr.LineStrips3D([shown.path], colors=[_PATH], radii=rr.Radius.ui_points(2))
        recording.log("map/path/after", line)
        log_objects(recording, shown.map, eye, shown.path, static=False)
        if shown.base is not None:
            pose = rr.Transform3D(translation=shown.base[:3, 3], quaternion=rr.Quaternion(xyzw=quaternion(shown.base)))
            recording.log("map/base", pose)
        n = shown.numbers
        resolved = len(shown.map.resolved())
        curves = {
            "lag/now": 1e3 * n["lag"],
            "lag/p50": 1e3 * n["p50"],
            "lag/p99": 1e3 * n["p99"],
            "objects/resolved": resolved,
            "objects/unresolved": len(shown.map) - resolved,
            "dropped/messages": sum(shown.dropped.values()),
            "dropped/snapshots": n["unseen"],
        }
        for name, value in curves.items():
            recording.log(f"plots/live/{name}", rr.Scalars(value))
        for level, text in map_changes(self._map, shown.map):
            recording.log("log", rr.TextLog(text, level=level))
        self._map = shown.map
        recording.log("summary", rr.TextDocument(_counters(shown), media_type="text/markdown"), static=True)

    def _frame(self, frame: Frame, objects: ObjectMap) -> None:
        import rerun as rr

        recording, path, pose = self._recording, self._cameras[frame.camera.name], frame.map_T_camera
        recording.log(path, rr.Transform3D(translation=pose[:3, 3], quaternion=rr.Quaternion(xyzw=quaternion(pose))))
        if isinstance(frame.image, bytes):
            recording.log(f"{path}/image", rr.EncodedImage(contents=frame.image, media_type="image/jpeg"))
        place = {o.id: i for i, o in enumerate(objects.objects)}
        index = np.array([place.get(j, -1) for j in frame.objects.tolist()], dtype=np.int64)
        palette = np.array([lighter(c) for c in colours(objects)], dtype=np.uint8).reshape(-1, 3)
        used = (index >= 0) & ~frame.rejected
        kind = np.where(frame.rejected[:, None], RAY_COLOURS["rejected"], RAY_COLOURS["unexplained"])
        colour, ray_colour = kind.copy(), np.where(used[:, None], RAY_COLOURS["used"], kind)
        colour[used] = palette[index[used]]
        boxes = frame.boxes
        archetype = rr.Boxes2D(
            centers=(boxes[:, :2] + boxes[:, 2:]) / 2,
            half_sizes=(boxes[:, 2:] - boxes[:, :2]) / 2,
            colors=colour.astype(np.uint8),
            radii=rr.Radius.ui_points(1.5),
        )
        recording.log(f"{path}/boxes", archetype)
        rays = rr.LineStrips3D(
            _rays(frame, objects, index), colors=ray_colour.astype(np.uint8), radii=rr.Radius.ui_points(1.5)
        )
        recording.log("map/rays/now", rays)


def _rays(frame: Frame, objects: ObjectMap, index: Ints) -> NDArray[np.float32]:
    """(B, 2, 3) from the camera through each box as far as its object, or a little way where it has none."""
    pixels = (frame.boxes[:, :2] + frame.boxes[:, 2:]) / 2
    directions, _ = undistort(frame.camera, pixels)
    origin = frame.map_T_camera[:3, 3]
    ahead = directions @ frame.map_T_camera[:3, :3].T
    reach = np.full(len(pixels), _LOST)
    held = np.flatnonzero(index >= 0)
    if len(held):
        positions = np.stack([o.position for o in objects.objects])[index[held]]
        distance = np.linalg.norm(positions - origin, axis=1)
        reach[held] = np.where(np.isfinite(distance), distance, _LOST)
    return np.stack([np.broadcast_to(origin, ahead.shape), origin + reach[:, None] * ahead], axis=1).astype(np.float32)


def _counters(shown: Shown) -> str:
    rows = [(name, f"{value:g}") for name, value in shown.numbers.items() if name in ("keyframes", "rebuilds")]
    rows += [(name, str(value)) for name, value in shown.counters.items()]
    rows += [(f"dropped: {name}", str(value)) for name, value in shown.dropped.items()]
    if shown.numbers["unseen"]:
        rows.append(("snapshots that the viewer had no time for", f"{shown.numbers['unseen']:g}"))
    return "\n".join(["| | |", "|---|---:|", *(f"| {name} | {value} |" for name, value in rows)])
