"""recording.rrd: a run to look at and to play back with the rerun viewer."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from objslam.types import Truth
from objslam.viewer.blueprint import blueprint
from objslam.viewer.cameras import camera_path, log_cameras
from objslam.viewer.eye import first_eye
from objslam.viewer.objects import log_objects, log_truth
from objslam.viewer.paths import log_base, log_paths, thinned
from objslam.viewer.plots import log_costs, log_residuals, log_seconds
from objslam.viewer.rays import log_rays
from objslam.viewer.steps import log_steps
from objslam.viewer.story import Line, drive_lines, round_lines
from objslam.viewer.summary import summary_text
from objslam.viewer.surface import log_surfaces
from objslam.viewer.times import iteration_column, stamp_column

if TYPE_CHECKING:
    from objslam.results import RunResult

APPLICATION = "objslam"


def write_recording(result: RunResult, file: Path, truth: Truth | None = None) -> None:
    """Write a run as a rerun recording (.rrd) with its blueprint.

    Under `map` (z up, m): the paths, the objects, the truth, a sample of all rays, the reconstruction; on the timeline
    `stamp` the robot, its cameras with images, boxes and the map's objects in them, and the rays of the moment; on the
    timeline `iteration` the path and the objects after each step of the solver (`map/steps`). `plots` holds the curves,
    `log` the decisions of either timeline, `summary` the run in a table.
    OSError when the file cannot be written.
    """
    import rerun as rr

    recording = rr.RecordingStream(APPLICATION)
    # bytes in memory: a file sink writes in a thread of its own, and what the disk refuses there is a line on stderr
    memory = recording.memory_recording()
    recording.send_recording_name(str(result.summary.get("log", APPLICATION)))
    eye = first_eye(result.map, result.map_T_base[:, :3, 3])
    used = [c for i, c in enumerate(result.cameras) if (result.keyframes.camera == i).any()]
    cameras = [(camera_path(c), c.name) for c in used]
    recording.send_blueprint(blueprint(eye, cameras, solver=bool(result.trace)))
    recording.log("map", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    log_paths(recording, result, truth)
    log_surfaces(recording, result)
    log_objects(recording, result.map, eye, thinned(result.path_after, 500))
    if truth is not None and truth.objects:
        log_truth(recording, truth)
    if len(result.keyframes):
        log_base(recording, result)
        log_rays(recording, result)
        unread = log_cameras(recording, result, float(np.linalg.norm(eye.position - eye.target)))
        log_residuals(recording, result)
        lines = drive_lines(result)
        if unread:
            lines.insert(1, Line(lines[0].at, "WARN", f"{unread} images could not be read"))
        _log_lines(recording, lines, stamp_column)
    log_steps(recording, result)
    log_costs(recording, result)
    log_seconds(recording, result.summary.get("seconds", {}))
    _log_lines(recording, round_lines(result.trace, result.rays.label_names), _iterations)
    recording.log("summary", rr.TextDocument(summary_text(result), media_type="text/markdown"), static=True)
    file.write_bytes(memory.drain_as_bytes())


def _iterations(at: Any) -> Any:
    return iteration_column(at.astype(np.int64))


def _log_lines(recording: Any, lines: list[Line], column: Any) -> None:
    import rerun as rr

    if lines:
        at = np.array([line.at for line in lines], dtype=np.float64)
        columns = rr.TextLog.columns(text=[line.text for line in lines], level=[line.level for line in lines])
        recording.send_columns("log", [column(at)], columns)
