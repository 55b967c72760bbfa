"""Add appearance vectors to the boxes of a log. An image encoder makes each vector from the crop of a box."""

from dataclasses import replace
from functools import partial
from itertools import pairwise

import numpy as np

from objslam.core.appearance.features import unit_vectors
from objslam.core.arrays import Array
from objslam.core.camera import Camera, spoken_name
from objslam.core.diagnostics import Ledger
from objslam.core.types import Detections, Images, Log
from objslam.detection.detect_log import Progress, load_frame
from objslam.detection.encoder import Encoder
from objslam.errors import LogError
from objslam.frontend.box_depths import MAX_IMAGE_LAG, nearest_stamps
from objslam.io.threads import ahead

_AHEAD = 8  # The number of images that are decoded before the network needs them. A larger number needs more memory.


def embed_log(log: Log, encoder: Encoder, ledger: Ledger, progress: Progress = lambda stage, done, total: None) -> Log:
    """Return the log with an appearance vector for each box that has an rgb image. The vectors replace the vectors of the
    log.

    The image of a frame is the nearest image in time, at most `MAX_IMAGE_LAG` (s) away. A frame without a usable image is
    counted as dropped, and its boxes get no vector. Raises LogError if no frame has an image, and DetectorError if the
    network fails.
    """
    cameras, seen = [], 0
    for camera_log in log.cameras:
        found, images = camera_log.detections, camera_log.rgb
        if found is not None and images is not None and len(found):
            if found.features is not None:
                ledger.warn(f"{spoken_name(camera_log.camera.name)}: the encoder's vectors replace the vectors of the log")
            found = _embedded(found, images, camera_log.camera, encoder, ledger, progress)
            seen += found.features is not None
        cameras.append(replace(camera_log, detections=found))
    if not seen:
        raise LogError(
            "no box has an rgb image for the encoder",
            where=log.name,
            hint="list the images in rgb.txt, one a line: stamp path",
        )
    return replace(log, cameras=tuple(cameras))


def _embedded(
    found: Detections, images: Images, camera: Camera, encoder: Encoder, ledger: Ledger, progress: Progress
) -> Detections:
    frames = np.unique(found.frame)
    bounds = [*np.searchsorted(found.frame, frames).tolist(), len(found)]
    closest = nearest_stamps(images.stamps, found.frame_stamps[frames])
    near = np.abs(images.stamps[closest] - found.frame_stamps[frames]) <= MAX_IMAGE_LAG
    where = f"stamp {found.frame_stamps[frames[np.argmin(near)]]:.3f}"
    ledger.drop("features of a frame without an rgb image", int((~near).sum()), where)
    parts = [slice(a, b) for (a, b), fits in zip(pairwise(bounds), near, strict=True) if fits]
    rows: list[tuple[slice, Array]] = []
    load = partial(load_frame, camera=camera, cache=None)
    for done, (part, frame) in enumerate(
        zip(parts, ahead(load, [images.paths[i] for i in closest[near]], _AHEAD), strict=True)
    ):
        progress("appearance of the boxes", done, len(parts))
        if frame.image is None:
            ledger.drop(frame.problem or "rgb image that cannot be read", where=frame.where)
        else:
            rows.append((part, encoder.encode(frame.image, found.boxes[part])))
    if not rows:
        return replace(found, features=None)
    features = np.full((len(found), rows[0][1].shape[1]), np.nan, dtype=np.float32)
    for part, vectors in rows:
        features[part], good = unit_vectors(vectors)
        ledger.drop("features of a box that the encoder makes zero or not finite", int((~good).sum()))
    return replace(found, features=features)
