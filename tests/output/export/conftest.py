"""A result to export: a small drive, mapped from its odometry."""

from dataclasses import replace
from pathlib import Path

import pytest

from objslam.config import load_settings
from objslam.core.diagnostics import Ledger
from objslam.core.result import RunResult
from objslam.io.results.read import load_map
from objslam.mapping.pipeline import run
from objslam.output.result_folder import write_result
from objslam.simulation import preset, simulate

LEAN = ("output.recording=false", "output.picture=false", "checks.use=false", "bodies.use=false")


@pytest.fixture(scope="session")
def mapped() -> RunResult:
    log = simulate(preset("demo", frames=120), 3)
    return run(replace(log, localization=None), load_settings(None, ("mode=joint", *LEAN)), Ledger())


@pytest.fixture(scope="session")
def result(mapped: RunResult, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Its folder, with one object that has no place, and a label that looks like a path and more."""
    first, second, *rest = mapped.map.objects
    lost = replace(second, status="unresolved", covariance=None)
    odd = replace(first, label='a "cup", ../é\n1')
    folder = tmp_path_factory.mktemp("export") / "out"
    write_result(replace(mapped, map=replace(mapped.map, objects=(odd, lost, *rest))), folder)
    assert len(load_map(folder).resolved()) >= 3
    return folder
