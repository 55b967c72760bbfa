"""The names of the files of a result, and how plain data becomes JSON."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np

OBJECTS = "objects.json"  # The map.
TRAJECTORY = "trajectory.txt"  # map_T_base at each keyframe's stamp.
RAYS = "rays.parquet"  # Every ray, with its object.
MOTIONS = "motions.parquet"  # The odometry between the poses of a joint run.
CONFIG = "config.yaml"  # All settings of the run.
SUMMARY = "summary.json"  # Counts, times and warnings; it is written last, so it says that the result is whole.
DETECTIONS = "detections.jsonl"  # The boxes that the run's own detector found.
SURFACE = "reconstruction.ply"  # The room as a mesh.
SURFACE_BEFORE = "reconstruction_before.ply"  # The same mesh at the poses that the log brought.
CLOUD = "reconstruction_cloud.ply"  # The vertices of the mesh as a point cloud.
PICTURE = "map.png"  # The map from above.
RECORDING = "recording.rrd"  # What the viewer plays.
EVALUATION = "evaluation.json"  # What `objslam eval` found.
REPORT = "report.html"  # What `objslam report` wrote.
TRUTH_OBJECTS = "groundtruth_objects.json"  # The true objects that the log brought.
TRUTH_TRAJECTORY = "groundtruth_trajectory.txt"  # The true path that the log brought.
GROUNDTRUTH = "groundtruth"  # The folder of a log in which OBJECTS and TRAJECTORY are the truth.

PARTS = (
    *(OBJECTS, TRAJECTORY, RAYS, CONFIG, TRUTH_OBJECTS, TRUTH_TRAJECTORY, DETECTIONS, PICTURE, RECORDING),
    *(SURFACE, SURFACE_BEFORE, CLOUD, MOTIONS, EVALUATION, REPORT),
)
"""Every file of a result but SUMMARY and what was exported; those of the commands that come after the run are among them."""


def hint_below(folder: Path) -> str | None:
    """A hint that names the results in the folders of a folder; None where there is none."""
    below = sorted(str(file.parent) for file in folder.glob(f"*/{SUMMARY}"))
    if not below:
        return None
    more = f" and {len(below) - 5} more" if len(below) > 5 else ""
    return f"its results lie in folders of their own: {', '.join(below[:5])}{more}"


def dump_json(data: Any) -> str:
    """Data as JSON text; arrays become lists, and what is not finite becomes null."""
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
