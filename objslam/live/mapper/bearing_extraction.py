"""Converts the boxes of an image to bearings, from the stored calibrations and mounts of the cameras."""

from collections import Counter
from dataclasses import dataclass, replace

import numpy as np

from objslam.core.arrays import Bools, Floats, Ints
from objslam.core.camera import Camera, box_sizes, same_lens
from objslam.core.noise import range_noise
from objslam.core.types import CameraLog
from objslam.frontend.bearings import box_rays, parts_of_things, surest
from objslam.frontend.boxes.ignored_labels import IGNORED_LABELS
from objslam.frontend.boxes.second_labels import SECOND_LABELS, tells_labels
from objslam.frontend.corrected_log import corrected_camera, corrected_mount, lens_errors, refocused
from objslam.frontend.surface_ranges import corrected_ranges, half_widths, range_factors, to_centres
from objslam.live.mapper.frame_association import FrameRays
from objslam.live.mapper.state import MapState
from objslam.sources.journal.records import FrameMessage, HeldMounts, MountMessage

_MOUNTS = 4096  # The mounts that are kept for each camera. A larger number serves later frames, and costs memory.


@dataclass(frozen=True)
class FrameView:
    """The bearings of the usable boxes of an image. camera: the number of the image's camera.

    mount: (4, 4) base_T_camera as received. base_T_camera: (4, 4) the same, corrected for the shared errors. rays: the
    bearings.
    """

    camera: int
    mount: Floats
    base_T_camera: Floats
    rays: FrameRays


class BearingExtractor:
    """Gives numbers to cameras and labels in the order of arrival, and converts boxes to bearings, corrected for the shared
    errors.

    It appends new cameras and labels to the lists of the map.
    """

    def __init__(self, m: MapState) -> None:
        self._map, self._settings, self._ledger, self._labels = m, m.given, m.counters.ledger, m.labels
        self._camera_number: dict[str, int] = {}
        self._label_number: dict[str, int] = {}
        self._mounts: dict[str, HeldMounts] = {}

    def add_camera(self, camera: Camera) -> None:
        """Add a camera, or replace its calibration."""
        m = self._map
        number = self._camera_number.setdefault(camera.name, len(m.cameras))
        if m.frames[number] and not same_lens(camera, m.sent_cameras[number]):
            m.changed_cameras.add(camera.name)
        m.sent_cameras[number : number + 1] = [camera]
        m.cameras[number : number + 1] = [corrected_camera(CameraLog(camera), m.errors).camera] if m.errors else [camera]

    def add_mount(self, message: MountMessage) -> None:
        """Add a mount: a pose of a camera on the robot, valid from its stamp until the next mount."""
        self._mounts.setdefault(message.camera, HeldMounts(_MOUNTS)).add(message)

    def moves(self, camera: str) -> bool:
        """Return whether a camera, by its name, moves on the robot."""
        return camera in self._mounts

    def extract(self, frame: FrameMessage, stamp: float) -> FrameView:
        """Return the bearings of a frame. Count the dropped boxes. stamp: s, corrected for the camera's clock offset."""
        number, settings, errors = self._camera_number[frame.camera], self._settings, self._map.errors
        camera, held = self._map.sent_cameras[number], self._mounts.get(frame.camera)
        mount = camera.base_T_camera if held is None else held.at(stamp, camera)
        base_T_camera = self._map.cameras[number].base_T_camera
        if held is not None:
            base_T_camera = corrected_mount(mount, errors, frame.camera) if errors else mount
        frame, label = self._without_repeats(frame, camera, number)
        kept, direction, sigma = box_rays(
            frame.boxes, frame.scores, frame.stamp, camera, settings, self._ledger, frame.whole
        )
        few = surest(np.zeros(len(kept), dtype=np.int64), label[kept], frame.scores[kept], camera, self._ledger)
        kept, direction, sigma = kept[few], direction[few], sigma[few]
        same = np.zeros(len(kept), dtype=np.int64)
        half = half_widths(frame.boxes[kept], direction, [camera], same)
        reach = frame.depths[kept] / direction[:, 2] if settings.depth.use else np.full(len(kept), np.nan)
        reach = reach * to_centres(half, settings.depth.centre)
        lens, longer = lens_errors(errors, frame.camera), range_factors(errors, half)
        rays = FrameRays(
            direction=refocused(direction, lens)[0] if any(lens) else direction,
            sigma=sigma,
            range=corrected_ranges(errors, reach, direction, longer),
            range_sigma=range_noise(reach, half, same, [camera], settings)[0] * longer,
            label=label[kept],
            score=frame.scores[kept],
            box=frame.boxes[kept],
            size=box_sizes(frame.boxes[kept], direction, [camera], same) * camera.sees_size,
            track=frame.track_ids[kept],
        )
        return FrameView(number, mount, base_T_camera, rays)

    def _without_repeats(self, frame: FrameMessage, camera: Camera, number: int) -> tuple[FrameMessage, Ints]:
        """Return the frame without ignored and second labels and without boxes of parts of things, and the label numbers of
        the boxes left.

        number: the number of the camera.
        """
        frame = self._without_ignored(frame)
        for name in sorted(set(frame.labels) - self._label_number.keys()):
            self._label_number[name] = len(self._labels)
            self._labels.append(name)
        label = np.array([self._label_number[name] for name in frame.labels], dtype=np.int64)
        frame, label = _without(self._second_labels(frame, label, camera, number), frame, label)
        measured = frame.boxes, np.zeros(len(frame), dtype=np.int64), label, frame.scores, frame.stamp
        return _without(parts_of_things(*measured, camera, self._settings, self._ledger, frame.whole), frame, label)

    def _without_ignored(self, frame: FrameMessage) -> FrameMessage:
        """Return the frame without the boxes of labels that the user does not want in the map. Count these boxes."""
        ignored = self._settings.rays.ignore_labels
        if not ignored:
            return frame
        gone = np.array([name in ignored for name in frame.labels], dtype=bool)
        for name, count in Counter(name for name in frame.labels if name in ignored).items():
            self._map.ignored[name] += count
            self._ledger.drop(IGNORED_LABELS, count, name)
        return _without(gone, frame, np.zeros(len(frame), dtype=np.int64))[0]

    def _second_labels(self, frame: FrameMessage, label: Ints, camera: Camera, number: int) -> Bools:
        """Return which boxes (n,) of the frame give a second label to the thing of another box. Count these boxes."""
        second = np.zeros(len(frame), dtype=bool)
        if not self._settings.rays.second_labels or not tells_labels(camera, frame.whole):
            return second
        sure = np.flatnonzero(frame.scores >= self._settings.rays.min_score)
        gone, below = self._map.second_labels.add(number, frame.boxes[sure], label[sure], frame.scores[sure])
        second[sure[gone]] = True
        for box, other in zip(sure[gone].tolist(), sure[below].tolist(), strict=True):
            self._ledger.drop(SECOND_LABELS, 1, f"{frame.labels[box]} on {frame.labels[other]}")
        return second


def _without(gone: Bools, frame: FrameMessage, label: Ints) -> tuple[FrameMessage, Ints]:
    """Return the frame without some boxes (n,), and the labels (n,) of the others."""
    if not gone.any():
        return frame, label
    own = np.flatnonzero(~gone)
    labels = tuple(frame.labels[i] for i in own.tolist())
    columns = {name: getattr(frame, name)[own] for name in ("boxes", "scores", "depths", "track_ids")}
    return replace(frame, labels=labels, **columns), label[own]
