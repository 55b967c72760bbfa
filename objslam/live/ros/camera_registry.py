"""Cameras of a running robot: calibration and place put together, and boxes that wait until both are known."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from objslam.core.arrays import Floats
from objslam.core.camera import Camera
from objslam.errors import LogError
from objslam.io.camera_yaml import Calibration
from objslam.live.interface import Sink
from objslam.live.ros.boxes import Boxes, Drop
from objslam.live.ros.depth_images import DepthImages
from objslam.ros.bag.records import frame_name
from objslam.ros.messages.camera_info import camera_names, camera_of
from objslam.ros.messages.detections import boxes_of_points
from objslam.ros.tf.buffer import TfBuffer, UnknownTransform
from objslam.ros.tf.frames import unchanged
from objslam.ros.topics import closeness, is_named, is_rectified

PATIENCE = 1.0  # The time that boxes wait for their camera's calibration and place, s; larger: a transform may come later.
_DEPTH_WAIT = 0.2  # The time that boxes wait for their depth image, s; larger: a slower camera's depths count.
_MAX_WAITING = 200  # The most images whose boxes wait; chosen to bound the memory.
_IMAGES = 4  # The images of a camera that are kept for a view; chosen to bound the memory.
_SAME = 0.001  # The most by which the stamps of an image and its boxes differ, s; far below the time between two images.
_MAX_CAMERAS = 64  # The most cameras that are kept; chosen to bound the memory.


@dataclass
class _Known:
    """A camera: the frame of the CameraInfo that it is from ("" for a file's), the frame that tf places it by, the optical
    frame in that, whether a file places it, and the base_T_camera that was pushed last."""

    camera: Camera
    source: str
    frame: str
    frame_T_camera: Floats
    placed: bool
    pushed: Floats | None = None


class Cameras:
    """Pushes each camera once it is calibrated and placed, its mount where it moves, and its boxes, in their order."""

    def __init__(
        self,
        sink: Sink,
        tf: TfBuffer,
        base: Callable[[], str],
        drop: Drop,
        calibrations: Sequence[Calibration] = (),
        rectified: bool | None = None,
    ) -> None:
        self._sink, self._tf, self._base, self._drop = sink, tf, base, drop
        self._calibrations, self._rectified = calibrations, rectified
        self._infos: dict[str, tuple[bytes, str, Any]] = {}
        self._known: dict[str, _Known] = {}
        self._frames: list[str] = []
        self._waiting: deque[Boxes] = deque()
        self._topics: dict[str, str] = {}
        self._depths = DepthImages(drop)
        self._images: dict[str, deque[tuple[float, NDArray[np.uint8]]]] = {}

    def add_info(self, topic: str, info: Any) -> None:
        """Take a sensor_msgs/CameraInfo: a calibration that changes is pushed again, with the next boxes."""
        frame = frame_name(info.header.frame_id)
        key = _fingerprint(info)
        old = self._infos.get(frame)
        if old is not None and old[0] == key:
            return
        if old is None and len(self._infos) >= _MAX_CAMERAS:
            self._drop(f"CameraInfo beyond the first {_MAX_CAMERAS} cameras", topic)
            return
        self._infos[frame] = key, topic, info
        self._known = {name: known for name, known in self._known.items() if frame not in (name, known.source)}

    def add_depth(self, topic: str, message: Any, stamp: float) -> None:
        """Take a depth image, registered to the camera whose frame it has: the boxes of that moment get their depths."""
        self._depths.add(topic, message, stamp)

    def add(self, boxes: Boxes) -> None:
        """Push boxes, or keep them until they can be. Of each camera, those of one topic: two would count things twice."""
        if len(self._topics) < _MAX_CAMERAS and self._topics.setdefault(boxes.frame, boxes.topic) != boxes.topic:
            self._drop("detection frame of a camera from another topic than the one taken", boxes.place)
            return
        if len(self._waiting) >= _MAX_WAITING:
            self._drop("detection frame while too many wait for their cameras", self._waiting.popleft().place)
        self._waiting.append(boxes)
        self.settle(boxes.arrived)

    def settle(self, now: float) -> None:
        """Push what has become known and drop what has waited too long; now: the clock of `arrived`, s."""
        still: deque[Boxes] = deque()
        held: set[str] = set()
        for boxes in self._waiting:
            reason = "waits for the boxes before it" if boxes.frame in held else self._push(boxes, now - boxes.arrived)
            if not reason:
                continue
            if now - boxes.arrived > PATIENCE:
                self._drop("detection frame whose camera is not calibrated or not placed", f"{boxes.place}: {reason}")
            else:
                held.add(boxes.frame)
                still.append(boxes)
        self._waiting = still

    def _push(self, boxes: Boxes, waited: float) -> str:
        """Push boxes, "" if that is done (or they are dropped for good), else why they must wait."""
        known = self._known.get(boxes.frame) or self._make(boxes, waited)
        if isinstance(known, str):
            return known
        camera, name = known.camera, known.camera.name
        if boxes.size is not None and boxes.size != (camera.width, camera.height):
            size = f"{boxes.size[0]}x{boxes.size[1]}, not {camera.width}x{camera.height}"
            self._drop("image that has not the size of its camera", f"{boxes.place}: {size}")
            return ""
        try:
            place = camera.base_T_camera if known.placed else self._place(known, boxes.stamp)
        except UnknownTransform as unknown:
            if unknown.later:
                return str(unknown)
            self._drop("detection frame whose camera's place at that time is not known", f"{boxes.place}: {unknown}")
            return ""
        if waited < _DEPTH_WAIT and self._depths.awaits(boxes):
            return "its depth image has not come"
        if known.pushed is None:
            self._sink.push_camera(replace(camera, base_T_camera=place))
        elif not unchanged(place, known.pushed):
            self._sink.push_mount(boxes.stamp, name, place)
        known.pushed = place
        if boxes.points:
            boxes.boxes[list(boxes.points)] = boxes_of_points(camera, np.array(list(boxes.points.values())))
        depths = self._depths.at(boxes, camera)
        found = boxes.boxes, boxes.labels, boxes.scores, depths, boxes.track_ids, boxes.whole
        self._sink.push_detections(boxes.stamp, name, *found)
        if boxes.image is not None:
            self._images.setdefault(name, deque(maxlen=_IMAGES)).append((boxes.stamp, boxes.image))
        return ""

    def image(self, camera: str, stamp: float) -> NDArray[np.uint8] | None:
        """The image that a camera's boxes of a stamp, s, came from, where it is one of the newest."""
        return next((image for at, image in self._images.get(camera, ()) if abs(at - stamp) <= _SAME), None)

    def _place(self, known: _Known, stamp: float) -> Floats:
        return np.asarray(self._tf.at(self._base(), known.frame, stamp) @ known.frame_T_camera)

    def _make(self, boxes: Boxes, waited: float) -> _Known | str:
        """The camera of boxes that come from a new one, or why there is none yet."""
        if boxes.frame not in self._frames:
            if len(self._frames) >= _MAX_CAMERAS:
                return f"it is not among the first {_MAX_CAMERAS} cameras"
            self._frames.append(boxes.frame)
        if self._calibrations:
            calibration = self._calibration(boxes)
            if calibration is None:
                return f"no calibration is for the frame {boxes.frame!r}"
            given = calibration.camera
            known = _Known(given, "", boxes.frame, given.base_T_camera, calibration.placed)
        else:
            info = self._info(boxes, waited)
            if info is None:
                return f"no CameraInfo has the frame {boxes.frame!r}"
            source, topic, message = info
            name = camera_names(self._frames)[self._frames.index(boxes.frame)]
            rectified = is_rectified(boxes.topic) if self._rectified is None else self._rectified
            try:
                camera, frame_T_camera = camera_of(message, name, topic, rectified)
            except LogError as error:
                return str(error)
            placed_by = boxes.frame if boxes.frame in self._tf.frames else source
            known = _Known(camera, source, placed_by, frame_T_camera, placed=False)
        self._known[boxes.frame] = known
        return known

    def _calibration(self, boxes: Boxes) -> Calibration | None:
        if len(self._calibrations) == 1:
            return self._calibrations[0]
        return next((c for c in self._calibrations if is_named(c.camera.name, boxes.frame, boxes.topic)), None)

    def _info(self, boxes: Boxes, waited: float) -> tuple[str, str, Any] | None:
        """Frame, topic and message of the CameraInfo: of the same frame, or, after a while, of the nearest topic."""
        if boxes.frame in self._infos:
            return boxes.frame, *self._infos[boxes.frame][1:]
        if waited < PATIENCE / 2 or not self._infos:
            return None
        near = {frame: closeness(topic, boxes.topic) for frame, (_, topic, _) in self._infos.items()}
        best = max(near, key=lambda frame: near[frame])
        if near[best] == 0 and len(near) > 1:
            return None
        return best, *self._infos[best][1:]


def _fingerprint(info: Any) -> bytes:
    """All of a CameraInfo but its header."""
    numbers = [np.asarray(getattr(info, name, ()), dtype=np.float64).tobytes() for name in "dkrp"]
    region = info.roi
    size = info.width, info.height, info.distortion_model, info.binning_x, info.binning_y
    part = region.x_offset, region.y_offset, region.width, region.height
    return b"|".join(numbers) + repr((size, part)).encode()
