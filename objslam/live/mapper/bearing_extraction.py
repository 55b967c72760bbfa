"""Converts the boxes of an image to bearings, from the stored calibrations and mounts of the cameras."""

from dataclasses import dataclass

import numpy as np

from objslam.config import Settings
from objslam.core.arrays import Floats
from objslam.core.camera import Camera
from objslam.core.diagnostics import Ledger
from objslam.frontend.bearings import box_rays, surest
from objslam.live.mapper.frame_association import FrameRays
from objslam.sources.journal.records import FrameMessage, HeldMounts, MountMessage

_MOUNTS = 4096  # The mounts kept per camera. With more, frames of a camera on an arm may come later. They cost memory.


@dataclass(frozen=True)
class FrameView:
    """The bearings of the usable boxes of an image, with the number of its camera and base_T_camera (4, 4)."""

    camera: int
    base_T_camera: Floats
    rays: FrameRays


class BearingExtractor:
    """Numbers cameras and labels in the order of arrival, and converts boxes to bearings.

    cameras, labels: the lists of the map, to which new cameras and labels are appended.
    """

    def __init__(self, settings: Settings, ledger: Ledger, cameras: list[Camera], labels: list[str]) -> None:
        self._settings, self._ledger = settings, ledger
        self._cameras, self._labels = cameras, labels
        self._camera_number: dict[str, int] = {}
        self._label_number: dict[str, int] = {}
        self._mounts: dict[str, HeldMounts] = {}

    def add_camera(self, camera: Camera) -> None:
        """Add a camera, or replace its calibration."""
        number = self._camera_number.setdefault(camera.name, len(self._cameras))
        self._cameras[number : number + 1] = [camera]

    def add_mount(self, message: MountMessage) -> None:
        """Add a mount: a pose of a camera on the robot from a stamp on."""
        self._mounts.setdefault(message.camera, HeldMounts(_MOUNTS)).add(message)

    def extract(self, frame: FrameMessage) -> FrameView:
        """Return the bearings of a frame, with the mount of its camera at its stamp. Count the dropped boxes."""
        number, settings = self._camera_number[frame.camera], self._settings
        camera, held = self._cameras[number], self._mounts.get(frame.camera)
        base_T_camera = camera.base_T_camera if held is None else held.at(frame.stamp, camera)
        kept, direction, sigma = box_rays(frame.boxes, frame.scores, camera, settings, self._ledger, frame.whole)
        for name in sorted(set(frame.labels) - self._label_number.keys()):
            self._label_number[name] = len(self._labels)
            self._labels.append(name)
        label = np.array([self._label_number[name] for name in frame.labels], dtype=np.int64)
        few = surest(np.zeros(len(kept), dtype=np.int64), label[kept], frame.scores[kept], camera, self._ledger)
        kept, direction, sigma = kept[few], direction[few], sigma[few]
        reach = frame.depths[kept] / direction[:, 2] if settings.depth.use else np.full(len(kept), np.nan)
        rays = FrameRays(
            direction=direction,
            sigma=sigma,
            range=reach,
            range_sigma=settings.depth.sigma + settings.depth.sigma_per_m * reach,
            label=label[kept],
            score=frame.scores[kept],
            box=frame.boxes[kept],
            track=frame.track_ids[kept],
        )
        return FrameView(number, base_T_camera, rays)
