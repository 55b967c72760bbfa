"""What there is to export of a result."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from objslam.motions_file import Motions
from objslam.results import load_map, load_motions, load_trajectory
from objslam.types import ObjectMap, Trajectory


@dataclass(frozen=True)
class Content:
    """A result read back: its folder's path, the objects, map_T_base, and the odometry between its poses (None without)."""

    out: Path
    objects: ObjectMap
    path: Trajectory
    motions: Motions | None


def load_content(out: Path) -> Content:
    """Read a result folder; OutputError says what is missing or malformed."""
    return Content(out, load_map(out), load_trajectory(out), load_motions(out))
