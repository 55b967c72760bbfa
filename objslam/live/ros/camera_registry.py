"""The calibrations and mounts of a running robot's cameras, and the boxes that wait until both are known."""

from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from objslam.core.arrays import Floats
from objslam.core.camera import Camera
from objslam.errors import LogError
from objslam.io.camera_yaml import Calibration, Mount
from objslam.live.interface import Sink
from objslam.live.ros.boxes import Boxes, DepthImages, Drop
from objslam.ros.bag.records import frame_name
from objslam.ros.messages.camera_info import camera_names, camera_of
from objslam.ros.messages.detections import boxes_of_points
from objslam.ros.tf.buffer import TfBuffer, UnknownTransform
from objslam.ros.tf.frames import unchanged
from objslam.ros.topics import closeness, is_named, is_rectified, mount_of

PATIENCE = 1.0  # The time that boxes wait for their camera's calibration and transform, s. A larger value drops fewer boxes.
_DEPTH_WAIT = 0.2  # The time that boxes wait for their depth image, s. A larger value serves slower cameras.
_MAX_WAITING = 200  # The most images whose boxes wait. A larger number costs memory.
_IMAGES = 4  # The number of images per camera that are kept for display. A larger number costs memory.
_SAME = 0.001  # The largest difference of the stamps of an image and its boxes, s. Two images are much further apart.
_MAX_CAMERAS = 64  # The most cameras that are kept. A larger number costs memory.


@dataclass
class _Known:
    """A calibrated camera.

    source: the tf frame in the camera's CameraInfo, or "" if a file gives the calibration. frame: the camera's tf frame.
    frame_T_camera: (4, 4) the pose of the camera's optical frame in `frame`. placed: whether a file gives base_T_camera.
    pushed: the last base_T_camera that was pushed.
    """

    camera: Camera
    source: str
    frame: str
    frame_T_camera: Floats
    placed: bool
    pushed: Floats | None = None


class Cameras:
    """Pushes each camera when its calibration and mount are known. Then pushes its boxes in order, and its mount when that
    changes.

    base: returns the name of the base frame. calibrations: calibrations from a file, used instead of CameraInfo. rectified:
    whether boxes are in rectified images. With None, the names of the topics decide. mounts: mounts from a file, used
    instead of tf.
    """

    def __init__(
        self,
        sink: Sink,
        tf: TfBuffer,
        base: Callable[[], str],
        drop: Drop,
        calibrations: Sequence[Calibration],
        rectified: bool | None,
        mounts: Sequence[Mount] = (),
    ) -> None:
        self._sink, self._tf, self._base, self._drop = sink, tf, base, drop
        self._calibrations, self._rectified, self._mounts = calibrations, rectified, mounts
        self._infos: dict[str, tuple[bytes, str, Any]] = {}
        self._known: dict[str, _Known] = {}
        self._frames: list[str] = []
        self._waiting: deque[Boxes] = deque()
        self._topics: dict[str, str] = {}
        self._images: dict[str, deque[tuple[float, NDArray[np.uint8]]]] = {}
        self.depths = DepthImages(drop)

    def add_info(self, topic: str, info: Any) -> None:
        """Take a sensor_msgs/CameraInfo. A changed calibration is pushed together with the next boxes."""
        frame = frame_name(info.header.frame_id)
        key = _fingerprint(info)
        old = self._infos.get(frame)
        if old is None and len(self._infos) >= _MAX_CAMERAS:
            self._drop(f"CameraInfo beyond the first {_MAX_CAMERAS} cameras", topic)
        elif old is None or old[0] != key:
            self._infos[frame] = key, topic, info
            self._known = {name: known for name, known in self._known.items() if frame not in (name, known.source)}

    def add(self, boxes: Boxes) -> None:
        """Push boxes, or keep them until they can be pushed.

        Boxes from a second topic of one camera are dropped, because they would count objects twice.
        """
        if len(self._topics) < _MAX_CAMERAS and self._topics.setdefault(boxes.frame, boxes.topic) != boxes.topic:
            self._drop("detection frame from a second topic of its camera", boxes.place)
            return
        if len(self._waiting) >= _MAX_WAITING:
            self._drop("detection frame dropped because too many wait for their cameras", self._waiting.popleft().place)
        self._waiting.append(boxes)
        self.settle(boxes.arrived)

    def settle(self, now: float) -> None:
        """Push the boxes whose cameras are now known. Drop boxes that waited too long. now: s, on the clock of `arrived`."""
        still: deque[Boxes] = deque()
        held: set[str] = set()
        for boxes in self._waiting:
            reason = "earlier boxes of the camera wait" if boxes.frame in held else self._push(boxes, now - boxes.arrived)
            if reason and now - boxes.arrived > PATIENCE:
                self._drop("detection frame of a camera without calibration or transform", f"{boxes.place}: {reason}")
            elif reason:
                held.add(boxes.frame)
                still.append(boxes)
        self._waiting = still

    def _push(self, boxes: Boxes, waited: float) -> str:
        """Push or drop boxes and return "", or return the reason why they must wait."""
        known = self._known.get(boxes.frame) or self._make(boxes, waited)
        if isinstance(known, str):
            return known
        camera, name = known.camera, known.camera.name
        if boxes.size is not None and boxes.size != (camera.width, camera.height):
            size = f"{boxes.size[0]}x{boxes.size[1]}, not {camera.width}x{camera.height}"
            self._drop("image that does not have the size of its camera", f"{boxes.place}: {size}")
            return ""
        place = camera.base_T_camera
        if not known.placed:
            try:
                place = np.asarray(self._tf.at(self._base(), known.frame, boxes.stamp) @ known.frame_T_camera)
            except UnknownTransform as unknown:
                if unknown.later:
                    return str(unknown)
                self._drop("detection frame without a transform of its camera at that time", f"{boxes.place}: {unknown}")
                return ""
        if waited < _DEPTH_WAIT and self.depths.awaits(boxes):
            return "its depth image has not arrived"
        if known.pushed is None:
            self._sink.push_camera(replace(camera, base_T_camera=place))
        elif not unchanged(place, known.pushed):
            self._sink.push_mount(boxes.stamp, name, place)
        known.pushed = place
        if boxes.points:
            boxes.boxes[list(boxes.points)] = boxes_of_points(camera, np.array(list(boxes.points.values())))
        depths = self.depths.at(boxes, camera)
        found = boxes.boxes, boxes.labels, boxes.scores, depths, boxes.track_ids, boxes.whole
        self._sink.push_detections(boxes.stamp, name, *found)
        if boxes.image is not None:
            self._images.setdefault(name, deque(maxlen=_IMAGES)).append((boxes.stamp, boxes.image))
        return ""

    def image(self, camera: str, stamp: float) -> NDArray[np.uint8] | None:
        """Return the image of the camera of a name at a stamp, s. Return None if it is not among the newest images."""
        return next((image for at, image in self._images.get(camera, ()) if abs(at - stamp) <= _SAME), None)

    def _make(self, boxes: Boxes, waited: float) -> _Known | str:
        """Make the camera of boxes whose camera is new, or return the reason why it cannot be made. waited: s."""
        frame = boxes.frame
        if frame not in self._frames:
            if len(self._frames) >= _MAX_CAMERAS:
                return f"it is not among the first {_MAX_CAMERAS} cameras"
            self._frames.append(frame)
        if self._calibrations:
            named = [c for c in self._calibrations if is_named(c.camera.name, frame, boxes.topic)]
            calibration = next(iter(self._calibrations if len(self._calibrations) == 1 else named), None)
            if calibration is None:
                return f"no calibration is for the frame {frame!r}"
            given = calibration.camera
            known = _Known(given, "", frame, given.base_T_camera, calibration.placed)
        else:
            source = self._source(boxes, waited)
            if source is None:
                return f"no CameraInfo has the frame {frame!r}"
            _, topic, message = self._infos[source]
            name = camera_names(self._frames)[self._frames.index(frame)]
            rectified = is_rectified(boxes.topic) if self._rectified is None else self._rectified
            try:
                camera, frame_T_camera = camera_of(message, name, topic, rectified)
            except LogError as error:
                return str(error)
            placed_by = frame if frame in self._tf.frames else source
            mount = mount_of(self._mounts, frame, boxes.topic)
            if mount is not None:
                camera = replace(camera, base_T_camera=mount.base_T_camera)
            known = _Known(camera, source, placed_by, frame_T_camera, placed=mount is not None)
        self._known[frame] = known
        return known

    def _source(self, boxes: Boxes, waited: float) -> str | None:
        """Return the frame of the CameraInfo for boxes, or None before a CameraInfo has arrived. waited: the time that the
        boxes have waited, s.

        Usually this is the frame of the boxes. After half of `PATIENCE` without a CameraInfo of that frame, the CameraInfo
        of the topic with the most similar name is used.
        """
        if boxes.frame in self._infos:
            return boxes.frame
        if waited < PATIENCE / 2 or not self._infos:
            return None
        near = {frame: closeness(topic, boxes.topic) for frame, (_, topic, _) in self._infos.items()}
        best = max(near, key=lambda frame: near[frame])
        return None if near[best] == 0 and len(near) > 1 else best


def _fingerprint(info: Any) -> bytes:
    """Return the content of a CameraInfo without its header."""
    numbers = [np.asarray(getattr(info, name, ()), dtype=np.float64).tobytes() for name in "dkrp"]
    region = info.roi
    size = info.width, info.height, info.distortion_model, info.binning_x, info.binning_y
    part = region.x_offset, region.y_offset, region.width, region.height
    return b"|".join(numbers) + repr((size, part)).encode()
