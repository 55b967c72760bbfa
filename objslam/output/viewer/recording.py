"""The recording of a run, recording.rrd, for the rerun viewer."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import rerun as rr

from objslam.core.arrays import Floats
from objslam.core.result import RunResult
from objslam.core.types import Truth
from objslam.errors import one_line
from objslam.frontend.up import up_axis
from objslam.output.viewer.blueprint import blueprint
from objslam.output.viewer.cameras import camera_path, log_cameras
from objslam.output.viewer.doubts import log_doubts
from objslam.output.viewer.event_log import Event, drive_events, round_events, summary_text
from objslam.output.viewer.objects import log_objects, log_truth
from objslam.output.viewer.paths import log_base, log_paths, log_steps, thinned
from objslam.output.viewer.plots import log_costs, log_parameters, log_residuals
from objslam.output.viewer.rays import log_rays
from objslam.output.viewer.surface import log_surfaces
from objslam.output.viewer.times import iteration_column, stamp_column
from objslam.output.viewer.view_point import first_view_point

_AVOIDED = 500  # The most points of the path that labels avoid.


def write_recording(result: RunResult, file: Path, truth: Truth | None = None) -> None:
    """Write a run as a rerun recording (.rrd) with its blueprint.

    `map` (m) has the static data: paths, objects, ground truth, a sample of the rays, surfaces. On the timeline
    `stamp`, `map` also has the robot, its cameras with images, boxes and objects, and the rays of each stamp. On the
    timeline `iteration`, `map` has the path and the objects after each iteration of the solver. `plots` has curves, `log`
    has the events on both timelines, and `summary` has a table. Raises OSError if the file cannot be written.
    """
    recording = rr.RecordingStream("objslam")
    # The recording is kept in memory until the end, because a file sink does not raise an error on a full disk.
    memory = recording.memory_recording()
    recording.send_recording_name(one_line(result.summary.get("log", "objslam")))
    up = up_axis(result.keyframes)
    view_point = first_view_point(result.map, result.map_T_base[:, :3, 3], up)
    used = [c for i, c in enumerate(result.cameras) if (result.keyframes.camera == i).any()]
    cameras = [(camera_path(c), c.name) for c in used]
    recording.send_blueprint(
        blueprint(view_point, cameras, solver=bool(result.trace), calibrated=result.calibration is not None)
    )
    upright = f"RIGHT_HAND_{up[-1].upper()}_{'DOWN' if up.startswith('-') else 'UP'}"
    recording.log("map", getattr(rr.ViewCoordinates, upright), static=True)
    log_paths(recording, result, truth)
    log_surfaces(recording, result)
    log_objects(recording, result.map, view_point, thinned(result.path_after, _AVOIDED))
    log_doubts(recording, result)
    if truth is not None and truth.objects:
        log_truth(recording, truth)
    if len(result.keyframes):
        log_base(recording, result)
        log_rays(recording, result)
        unread = log_cameras(recording, result, view_point.distance)
        log_residuals(recording, result)
        events = drive_events(result)
        if unread:
            events.insert(1, Event(events[0].at, "WARN", f"{unread} images could not be read"))
        _log_events(recording, events, stamp_column)
    log_steps(recording, result)
    log_costs(recording, result)
    log_parameters(recording, result)
    rounds = round_events(result.trace, result.rays.label_names)
    _log_events(recording, rounds, lambda at: iteration_column(at.astype(np.int64)))
    recording.log("summary", rr.TextDocument(summary_text(result), media_type="text/markdown"), static=True)
    file.write_bytes(memory.drain_as_bytes())


def _log_events(recording: Any, events: list[Event], column: Callable[[Floats], Any]) -> None:
    if events:
        at = np.array([event.at for event in events], dtype=np.float64)
        columns = rr.TextLog.columns(text=[event.text for event in events], level=[event.level for event in events])
        recording.send_columns("log", [column(at)], columns)
