"""From frames to rays: cameras and their mounts as they come, and the numbers of labels."""

from __future__ import annotations

import bisect

import numpy as np

from objslam.config import Settings
from objslam.ledger import Ledger
from objslam.live.matching import FrameRays
from objslam.live.messages import FrameMessage, MountMessage
from objslam.rays import box_rays
from objslam.types import Camera, Detections, Floats, label_table

_MOUNTS = 4096  # of one camera that are kept


class FrameReader:
    """Knows the cameras: number of each by its name, and labels in the order in which they came."""

    def __init__(self, settings: Settings, ledger: Ledger) -> None:
        self._settings, self._ledger = settings, ledger
        self.cameras: list[Camera] = []
        self.number: dict[str, int] = {}
        self.labels: list[str] = []
        self._label_number: dict[str, int] = {}
        self._mounts: dict[str, tuple[list[float], list[Floats]]] = {}

    def add_camera(self, camera: Camera) -> None:
        """A camera, or another calibration of one."""
        if camera.name in self.number:
            self.cameras[self.number[camera.name]] = camera
        else:
            self.number[camera.name] = len(self.cameras)
            self.cameras.append(camera)

    def add_mount(self, message: MountMessage) -> None:
        """Where a camera is from now on."""
        stamps, poses = self._mounts.setdefault(message.camera, ([], []))
        at = bisect.bisect_right(stamps, message.stamp)
        stamps.insert(at, message.stamp)
        poses.insert(at, message.pose)
        if len(stamps) > _MOUNTS:
            del stamps[0], poses[0]

    def mount(self, frame: FrameMessage) -> Floats:
        """base_T_camera (4, 4) of a frame: of the last mount by then."""
        stamps, poses = self._mounts.get(frame.camera, ([], []))
        at = bisect.bisect_right(stamps, frame.stamp)
        return poses[at - 1] if at else self.cameras[self.number[frame.camera]].base_T_camera

    def rays(self, frame: FrameMessage) -> FrameRays:
        """The usable boxes of a frame as rays; drops are counted."""
        camera = self.cameras[self.number[frame.camera]]
        names, label = label_table(frame.labels)
        boxes = Detections(
            frame_stamps=np.array([frame.stamp]),
            frame=np.zeros(len(frame), dtype=np.int64),
            boxes=frame.boxes,
            label=label,
            scores=frame.scores,
            depths=frame.depths,
            track_ids=frame.track_ids,
            label_names=names,
            whole=frame.whole,
        )
        boxes, direction, sigma = box_rays(boxes, camera, self._settings, self._ledger)
        for name in names:
            if name not in self._label_number:
                self._label_number[name] = len(self.labels)
                self.labels.append(name)
        number = np.array([self._label_number[name] for name in names], dtype=np.int64)
        depth = boxes.depths if self._settings.depth.use else np.full(len(boxes), np.nan)
        reach = depth / direction[:, 2]
        return FrameRays(
            direction=direction,
            sigma=sigma,
            range=reach,
            range_sigma=self._settings.depth.sigma + self._settings.depth.sigma_per_m * reach,
            label=number[boxes.label] if len(boxes) else boxes.label,
            score=boxes.scores,
            box=boxes.boxes,
            track=boxes.track_ids,
        )
