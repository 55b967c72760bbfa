"""Processes of a fleet find the modules of the tests, and the store that fails. Several fleets share them."""

import os
from functools import cache
from pathlib import Path

import pytest

from objslam.fleet.engines import local_engine as engines

TESTS = Path(__file__).parents[1]


@pytest.fixture(autouse=True, scope="package")
def paths(tmp_path_factory):
    """Put the tests on the path of all processes, with a package whose entry point names the store `flaky`."""
    folder = tmp_path_factory.mktemp("plugins")
    info = folder / "flaky-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: flaky\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text("[fsspec.specs]\nflaky = fleet.fleet_logs:Flaky\n")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("PYTHONPATH", os.pathsep.join([str(folder), str(TESTS), os.environ.get("PYTHONPATH", "")]))
        yield folder


@pytest.fixture(autouse=True, scope="package")
def kept_processes(paths):
    """The commands in this process share one engine, so that its processes are started once, with a second for imports.

    A process does one task after another anyway. Tests of how processes start and end make engines of their own."""
    kept = cache(engines.local_engine)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(engines, "local_engine", kept)
        yield
    kept.cache_clear()
