"""The file names of a result, and the conversion of plain data to JSON."""

import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from objslam.core.result import Doubt

OBJECTS = "objects.json"  # The map of objects.
TRAJECTORY = "trajectory.txt"  # The pose map_T_base of each keyframe.
PATH = "path.txt"  # The pose map_T_base at each pose of the recorded path.
RAYS = "rays.parquet"  # Each ray with its object.
FEATURES = "features.parquet"  # The appearance vectors of the rays that have one.
MOTIONS = "motions.parquet"  # The odometry between the poses of a joint run.
VIEWS = "views.parquet"  # The pose of each camera frame. These poses show which objects the camera could have seen.
CONFIG = "config.yaml"  # All settings of the run.
DOUBTS = "doubts.json"  # The doubts: objects that may be one object or two, and boxes that became no object.
SUMMARY = "summary.json"  # Counts, times and warnings. It is written last, so it marks a complete result.
DETECTIONS = "detections.jsonl"  # The boxes from the detector of the run.
SURFACE = "reconstruction.ply"  # The mesh of the room.
SURFACE_BEFORE = "reconstruction_before.ply"  # The mesh of the room, made with the poses of the log.
CLOUD = "reconstruction_cloud.ply"  # The vertices of the mesh as a point cloud.
PICTURE = "map.png"  # The map from above.
RECORDING = "recording.rrd"  # The recording for the viewer.
EVALUATION = "evaluation.json"  # The evaluation that `objslam eval` writes.
REPORT = "report.html"  # The page that `objslam report` writes.
TRUTH_OBJECTS = "groundtruth_objects.json"  # The true objects of the log.
TRUTH_TRAJECTORY = "groundtruth_trajectory.txt"  # The true path of the log.
SITE_FRAME = "site"  # The value of the key `map_frame` in the summary of the map of a site.
GROUNDTRUTH = "groundtruth"  # The folder of the ground truth in a log. Its files have the names OBJECTS and TRAJECTORY.

PARTS = (
    *(OBJECTS, TRAJECTORY, PATH, RAYS, CONFIG, TRUTH_OBJECTS, TRUTH_TRAJECTORY, DETECTIONS, PICTURE, RECORDING),
    *(SURFACE, SURFACE_BEFORE, CLOUD, FEATURES, MOTIONS, VIEWS, DOUBTS, EVALUATION, REPORT),
)
"""The names of the files of a result and of later commands on it, without SUMMARY and without exported files."""


def hint_below(folder: Path) -> str | None:
    """Return a hint that lists up to 5 subfolders with results, or None if no subfolder has a result."""
    below = sorted(str(file.parent) for file in folder.glob(f"*/{SUMMARY}"))
    if not below:
        return None
    more = f" and {len(below) - 5} more" if len(below) > 5 else ""
    return f"its subfolders have results: {', '.join(below[:5])}{more}"


def dump_doubts(doubts: Sequence[Doubt]) -> str:
    """Return the content of doubts.json. Each doubt is one line."""
    lines = (json.dumps(one.to_dict(), ensure_ascii=False, allow_nan=False) for one in doubts)
    return '{"format": "objslam.doubts/1", "doubts": [' + ",".join(f"\n  {line}" for line in lines) + "\n]}\n"


def dump_json(data: Any) -> str:
    """Convert data to JSON text. Arrays become lists, and non-finite numbers become null."""
    return json.dumps(_plain(data), indent=2, ensure_ascii=False, allow_nan=False) + "\n"


def _plain(data: Any) -> Any:
    if isinstance(data, np.ndarray | np.generic):
        data = data.tolist()
    if isinstance(data, dict):
        return {str(key): _plain(value) for key, value in data.items()}
    if isinstance(data, list | tuple):
        return [_plain(value) for value in data]
    if isinstance(data, float) and not math.isfinite(data):
        return None
    return data
