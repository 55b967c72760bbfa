"""Detection in a log: each rgb image becomes a frame with boxes."""

import time
from collections.abc import Callable, Sequence
from contextlib import nullcontext
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from objslam.config import Settings
from objslam.core.arrays import Array, Floats
from objslam.core.diagnostics import Ledger
from objslam.core.types import CameraLog, Detections, Images, Log, label_table
from objslam.detection.cache import DetectionCache, Entry
from objslam.detection.detector import Boxes, Detector
from objslam.detection.image_loader import load_frame
from objslam.errors import LogError
from objslam.frontend.box_depths import depths_at_boxes
from objslam.io.prefetch import ahead

_AHEAD = 8  # The number of images decoded ahead of the network in addition to a batch.

Progress = Callable[[str, int, int], None]
"""A callback with the name of the stage, the number of finished items, and the total (0 if unknown)."""


def detect_log(
    log: Log,
    detector: Detector,
    settings: Settings,
    ledger: Ledger,
    *,
    cache: Path | None = None,
    progress: Progress = lambda stage, done, total: None,
) -> Log:
    """Return the log with detections from the rgb images, which replace the detections of the log.

    An image is dropped and counted if it cannot be read or decoded, or if its size is not the camera's. With `depth.use`, a
    box gets its depth from a depth image if the camera has depth images.

    Args:
        cache: folder of the `DetectionCache`. None disables the cache.
    Raises:
        LogError: no image can be used.
        DetectorError: the network fails.
    """
    total = sum(len(c.rgb.paths) for c in log.cameras if c.rgb is not None)
    if not total:
        raise LogError("no camera has rgb images for the detector", where=log.name, hint="rgb.txt lists them")
    for warning in detector.warnings:
        ledger.warn(warning)
    meter = _Meter(total, progress)
    with nullcontext() if cache is None else DetectionCache(cache, detector.key, ledger) as store:
        run = partial(_detect_images, detector=detector, store=store, ledger=ledger, meter=meter)
        found = [None if c.rgb is None else run(c, c.rgb) for c in log.cameras]
    frames = sum(len(d.frame_stamps) for d in found if d is not None)
    if not frames:
        reasons = "; ".join(line for line in ledger.lines() if "rgb image" in line)
        raise LogError(f"none of the {total} rgb images can be used", where=log.name, hint=reasons)
    if not any(len(d) for d in found if d is not None):
        ledger.warn(f"the detector found nothing in {frames} images: check detector.min_score and detector.layout")
    cameras = []
    for camera_log, detections in zip(log.cameras, found, strict=True):
        if detections is None:
            cameras.append(camera_log)
            continue
        if camera_log.detections is not None:
            ledger.warn(f"camera {camera_log.camera.name}: the boxes of the detector replace the boxes of the log")
        if camera_log.depth is not None and settings.depth.use:
            progress("depths at the boxes", 0, 0)
            detections = depths_at_boxes(detections, camera_log.depth, camera_log.camera, ledger)
        cameras.append(replace(camera_log, detections=detections))
    return replace(log, cameras=tuple(cameras))


class _Meter:
    """Report the progress and the rate in frames/s."""

    def __init__(self, total: int, progress: Progress) -> None:
        self._total, self._progress = total, progress
        self._done, self._begin = 0, time.perf_counter()
        progress("detecting", 0, total)

    def step(self) -> None:
        self._done += 1
        rate = self._done / max(time.perf_counter() - self._begin, 1e-6)
        self._progress(f"detecting, {rate:.1f} frames/s", self._done, self._total)


def _detect_images(
    camera_log: CameraLog, images: Images, *, detector: Detector, store: DetectionCache | None, ledger: Ledger, meter: _Meter
) -> Detections:
    camera = camera_log.camera
    found: list[Boxes | None] = [None] * len(images.paths)
    waiting: list[tuple[int, str, Array]] = []
    load = partial(load_frame, camera=camera, cache=store)
    for index, frame in enumerate(ahead(load, images.paths, _AHEAD + detector.batch)):
        if frame.problem is not None:
            ledger.drop(frame.problem, where=frame.where)
        elif frame.known is not None:
            found[index] = frame.known
        elif frame.image is not None:
            waiting.append((index, frame.digest, frame.image))
        if len(waiting) == detector.batch:
            _detect_batch(waiting, found, detector, store)
        meter.step()
    _detect_batch(waiting, found, detector, store)
    return _as_detections(images.stamps, found)


def _detect_batch(
    waiting: list[tuple[int, str, Array]], found: list[Boxes | None], detector: Detector, store: DetectionCache | None
) -> None:
    """Detect in the waiting images (index, digest, pixels), store boxes in found[index] and the cache, and empty
    `waiting`."""
    for (index, digest, image), boxes in zip(waiting, detector.detect([image for _, _, image in waiting]), strict=True):
        found[index] = boxes
        if store is not None:
            store.write(digest, Entry(image.shape[1], image.shape[0], boxes))
    waiting.clear()


def _as_detections(stamps: Floats, found: Sequence[Boxes | None]) -> Detections:
    used = [(stamp, boxes) for stamp, boxes in zip(stamps.tolist(), found, strict=True) if boxes is not None]
    counts = [len(boxes.scores) for _, boxes in used]
    label_names, label = label_table([name for _, boxes in used for name in boxes.labels])
    return Detections(
        frame_stamps=np.array([stamp for stamp, _ in used], dtype=np.float64),
        frame=np.repeat(np.arange(len(used)), counts),
        boxes=np.concatenate([np.zeros((0, 4)), *(boxes.boxes for _, boxes in used)]),
        label=label,
        scores=np.concatenate([np.zeros(0), *(boxes.scores for _, boxes in used)]),
        depths=np.full(sum(counts), np.nan),
        track_ids=np.full(sum(counts), -1, dtype=np.int64),
        label_names=label_names,
    )
