"""Run a detector on a log. The detector finds the boxes in each rgb image."""

import hashlib
from collections.abc import Callable, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, replace
from functools import partial
from itertools import count
from pathlib import Path

import numpy as np

from objslam.config import Settings
from objslam.core.arrays import Array, Floats
from objslam.core.camera import Camera, spoken_name
from objslam.core.diagnostics import Ledger
from objslam.core.types import CameraLog, Detections, Images, Log, label_table
from objslam.detection.cache import DetectionCache, Entry
from objslam.detection.detector import Boxes, Detector
from objslam.errors import LogError
from objslam.frontend.box_depths import depths_at_boxes
from objslam.io.images import decode_colour
from objslam.io.text import read_bytes
from objslam.io.threads import ahead

_AHEAD = 8
"""The number of images that are decoded before the network needs them, in addition to the images of a batch. A larger number
needs more memory."""

Progress = Callable[[str, int, int], None]
"""A callback that takes the name of the stage, the number of finished items, and the number of all items (0 if unknown)."""


def detect_log(
    log: Log,
    detector: Detector,
    settings: Settings,
    ledger: Ledger,
    *,
    cache: Path | None = None,
    progress: Progress = lambda stage, done, total: None,
) -> Log:
    """Run the detector on the rgb images, and return the log with the boxes found. Cameras without rgb images are unchanged.

    An image is dropped and counted if it cannot be read or decoded, or if its size is not the camera's. If the setting
    `depth.use` is True and the camera has depth images, each box gets its depth from a depth image. cache: the folder of the
    `DetectionCache`, or None for no cache. Raises LogError if no image can be used, and DetectorError if the network fails.
    """
    total = sum(len(c.rgb.paths) for c in log.cameras if c.rgb is not None)
    if not total:
        refused = [line for line in ledger.warnings if "rgb.txt" in line]  # The reader says what is wrong with a list.
        hint = "; ".join(refused) or "list them in rgb.txt, one a line: stamp path"
        raise LogError("no camera has rgb images for the detector", where=log.name, hint=hint)
    for warning in detector.warnings:
        ledger.warn(warning)
    done = count(1)

    def step() -> None:
        progress("detecting", next(done), total)

    progress("detecting", 0, total)
    with nullcontext() if cache is None else DetectionCache(cache, detector.key, ledger) as store:
        run = partial(_detect_images, detector=detector, store=store, ledger=ledger, step=step)
        found = [None if c.rgb is None else run(c.camera, c.rgb) for c in log.cameras]
    frames = sum(len(d.frame_stamps) for d in found if d is not None)
    if not frames:
        reasons = "; ".join(line for line in ledger.lines() if "rgb image" in line)
        raise LogError(f"none of the {total} rgb images can be used", where=log.name, hint=reasons)
    if not any(len(d) for d in found if d is not None):
        ledger.warn(f"the detector found nothing in {frames} images: check detector.min_score and detector.layout")
    cameras: list[CameraLog] = []
    for camera_log, detections in zip(log.cameras, found, strict=True):
        if detections is None:
            cameras.append(camera_log)
            continue
        if camera_log.detections is not None:
            ledger.warn(f"{spoken_name(camera_log.camera.name)}: the boxes of the detector replace the boxes of the log")
        if camera_log.depth is not None and settings.depth.use:
            progress("depths at the boxes", 0, 0)
            detections = depths_at_boxes(detections, camera_log.depth, camera_log.camera, ledger)
        cameras.append(replace(camera_log, detections=detections))
    return replace(log, cameras=tuple(cameras))


@dataclass(frozen=True)
class Frame:
    """One image file. known: the boxes from the cache, if any. image: the pixels, if the cache has no boxes of the image.

    problem: the reason why the image cannot be used, if any. where: the place of the problem. digest: SHA-256 of the file.
    """

    digest: str = ""
    image: Array | None = None
    known: Boxes | None = None
    problem: str | None = None
    where: str = ""


def load_frame(path: Path, camera: Camera, cache: DetectionCache | None) -> Frame:
    """Read an image file. If the cache has no boxes of the image, decode the image to 8-bit BGR without EXIF rotation."""
    try:
        data = read_bytes(path)
    except LogError as error:
        return Frame(problem="rgb image that cannot be read", where=str(error))
    digest = hashlib.sha256(data).hexdigest()
    image, entry = None, None if cache is None else cache.read(digest)
    if entry is not None:
        width, height = entry.width, entry.height
    elif (image := decode_colour(data)) is not None:
        height, width = image.shape[:2]
    else:
        return Frame(digest, problem="rgb image that cannot be decoded", where=str(path))
    if (width, height) != (camera.width, camera.height):
        where = f"{path} is {width}x{height}, the camera {camera.width}x{camera.height}"
        return Frame(digest, problem="rgb image that does not have the camera's size", where=where)
    return Frame(digest, image, None if entry is None else entry.boxes)


def _detect_images(
    camera: Camera,
    images: Images,
    *,
    detector: Detector,
    store: DetectionCache | None,
    ledger: Ledger,
    step: Callable[[], None],
) -> Detections:
    found: list[Boxes | None] = [None] * len(images.paths)
    waiting: list[tuple[int, str, Array]] = []

    def detect_waiting() -> None:
        for (index, digest, image), boxes in zip(waiting, detector.detect([image for *_, image in waiting]), strict=True):
            found[index] = boxes
            if store is not None:
                store.write(digest, Entry(image.shape[1], image.shape[0], boxes))
        waiting.clear()

    load = partial(load_frame, camera=camera, cache=store)
    for index, frame in enumerate(ahead(load, images.paths, _AHEAD + detector.batch)):
        if frame.problem is not None:
            ledger.drop(frame.problem, where=frame.where)
        elif frame.known is not None:
            found[index] = frame.known
        elif frame.image is not None:
            waiting.append((index, frame.digest, frame.image))
        if len(waiting) == detector.batch:
            detect_waiting()
        step()
    detect_waiting()
    return _as_detections(images.stamps, found)


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
