"""What a format writes: a result read back from its folder."""

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

    out: Path  # The result folder, for error messages.
    objects: ObjectMap
    path: Trajectory  # map_T_base at each keyframe's stamp.
    motions: Motions | None  # The odometry between consecutive poses of the path; None where the run used none.
    datum: Datum | None = None  # Where the map lies on the earth; None where nobody said.


def load_content(out: Path, datum: Datum | None = None) -> Content:
    """Read a result folder; OutputError says what is missing or malformed."""
    return Content(out, load_map(out), load_trajectory(out), load_motions(out), datum)
