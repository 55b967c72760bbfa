"""The checks of the input at the end of a session. They are the checks before an offline run, on the boxes that gave
rays."""

from dataclasses import replace

import numpy as np

from objslam.config import Settings
from objslam.core.arrays import Ints
from objslam.core.diagnostics import Ledger
from objslam.core.types import CameraLog, Detections, Log
from objslam.errors import LogError
from objslam.live.calibration.collected import Collected
from objslam.mapping.checks.diagnosis import Diagnosis, diagnose
from objslam.mapping.checks.finding import Finding


def diagnose_session(log: Log, settings: Settings, ledger: Ledger) -> Diagnosis:
    """Return the diagnosis of what a session received. log: the log from `with_boxes`.

    A joint solve comes after it, so `refuted.without_refuted` must test the findings. Wrong poses stay in the log, because
    the session has used them.
    """
    try:
        diagnosis = diagnose(log, settings, ledger)
    except LogError as error:  # An offline run would stop here. A session keeps its map with a finding.
        return Diagnosis((Finding("input", str(error)),))
    return replace(diagnosis, jumps=None)


def with_boxes(found: Collected) -> Log:
    """Return the log of a session with the boxes of its rays."""
    camera = found.keyframes.camera[found.rays.keyframe]
    logs = (_with_boxes_of(one, found, np.flatnonzero(camera == i)) for i, one in enumerate(found.log.cameras))
    return replace(found.log, cameras=tuple(logs))


def _with_boxes_of(camera: CameraLog, found: Collected, rows: Ints) -> CameraLog:
    """Return a camera of a log with the boxes of the rays in these rows (n,), in the order of their stamps."""
    rays = found.rays
    stamps, frame = np.unique(found.keyframes.stamps[rays.keyframe[rows]], return_inverse=True)
    order = np.argsort(frame, kind="stable")
    rows = rows[order]
    detections = Detections(
        frame_stamps=stamps,
        frame=frame[order],
        boxes=rays.box[rows],
        label=rays.label[rows],
        scores=rays.score[rows],
        depths=rays.range[rows] * rays.direction[rows, 2],  # Ranges are along the ray, depths along the optical axis.
        track_ids=rays.track_id[rows],
        label_names=rays.label_names,
    )
    return replace(camera, detections=detections)
