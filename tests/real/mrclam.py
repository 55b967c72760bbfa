"""Maps of UTIAS MRCLAM 6 that several tests look at. Each is made once in a process."""

from functools import cache
from pathlib import Path

from objslam.config import load_settings
from objslam.core.diagnostics import Ledger
from objslam.core.result import RunResult
from objslam.core.types import Log
from objslam.mapping import pipeline
from objslam.sources import SourceOptions, read


@cache
def mapped(data_dir: Path, robot: int, with_range: bool) -> tuple[Log, RunResult, Ledger]:
    """The log of a robot, its map in joint mode, and what the run warned of."""
    log, ledger = read(data_dir / "mrclam_ds6", Ledger(), SourceOptions(robot=robot, with_range=with_range)), Ledger()
    return log, pipeline.run(log, load_settings(None, ("mode=joint", "output.recording=false")), ledger), ledger
