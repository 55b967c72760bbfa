"""The content of an export: a result that is read back from its folder."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from objslam.core.object_map import ObjectMap
from objslam.core.types import Trajectory
from objslam.io.odometry_parquet import Motions
from objslam.output.export.datum import Datum
from objslam.results.read import load_map, load_motions, load_trajectory


@dataclass(frozen=True)
class Content:
    """A result to export."""

    out: Path  # The result folder; error messages name it.
    objects: ObjectMap
    path: Trajectory  # map_T_base at the stamp of each keyframe.
    motions: Motions | None  # The odometry between consecutive poses of the path; None if the run used no odometry.
    datum: Datum | None = None  # The position of the map on the earth; None if it is unknown.


def load_content(out: Path, datum: Datum | None = None) -> Content:
    """Read a result folder; OutputError names a missing or malformed file."""
    return Content(out, load_map(out), load_trajectory(out), load_motions(out), datum)
