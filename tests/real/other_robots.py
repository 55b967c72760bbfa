"""Drives of UTIAS MRCLAM whose boxes also show the other robots, which drive around."""

from pathlib import Path
from unittest.mock import patch

from objslam.core.diagnostics import Ledger
from objslam.core.types import Log
from objslam.sources import SourceOptions, read
from objslam.sources.mrclam import reader


def read_with_other_robots(folder: Path, robot: int, *, with_range: bool) -> Log:
    """The drive of a robot. Each other robot has a label of its own, from landmark_1 to landmark_5, and no true place."""
    with patch.object(reader, "ROBOTS", range(0)), patch.object(reader, "LANDMARKS", range(1, 21)):
        return read(folder, Ledger(), SourceOptions(robot=robot, with_range=with_range))
