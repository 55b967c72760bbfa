"""From frames to rays: cameras and their mounts as they come, and the numbers of labels."""

from __future__ import annotations

import bisect

import numpy as np

from objslam.config import Settings
from objslam.ledger import Ledger
from objslam.live.matching import FrameRays
from objslam.live.messages import FrameMessage, MountMessage
from objslam.rays import box_rays
from objslam.types import Camera, Floats

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
        camera, settings = self.cameras[self.number[frame.camera]], self._settings
        kept, direction, sigma = box_rays(frame.boxes, frame.scores, camera, settings, self._ledger, frame.whole)
        for name in sorted(set(frame.labels) - self._label_number.keys()):
            self._label_number[name] = len(self.labels)
            self.labels.append(name)
        label = np.array([self._label_number[name] for name in frame.labels], dtype=np.int64)
        reach = frame.depths[kept] / direction[:, 2] if settings.depth.use else np.full(len(kept), np.nan)
        return FrameRays(
            direction=direction,
            sigma=sigma,
            range=reach,
            range_sigma=settings.depth.sigma + settings.depth.sigma_per_m * reach,
            label=label[kept],
            score=frame.scores[kept],
            box=frame.boxes[kept],
            track=frame.track_ids[kept],
        )
