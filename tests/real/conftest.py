"""Real recordings: the folder named by OBJSLAM_DATA; without it these tests are skipped."""

import os
from pathlib import Path

import pytest

_DEFAULT = Path(__file__).resolve().parents[3] / "shared" / "data"


@pytest.fixture(scope="session")
def data_dir() -> Path:
    folder = Path(os.environ.get("OBJSLAM_DATA", _DEFAULT))
    if not folder.is_dir():
        pytest.skip(f"no real data at {folder}: name its folder in the environment variable OBJSLAM_DATA")
    return folder
