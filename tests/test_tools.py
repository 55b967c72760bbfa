"""The tools that read what a user names end as the commands do: an error is one line."""

import subprocess
import sys
from pathlib import Path

import pytest
from waiting import LIMIT

TOOLS = Path(__file__).resolve().parent.parent / "tools"


@pytest.mark.parametrize("tool", ["fig2", "bench_reconstruction", "bench_viewer", "bench_detection"])
def test_a_missing_input_is_one_line(tool, tmp_path):
    words = [sys.executable, str(TOOLS / f"{tool}.py"), str(tmp_path / "nowhere")]
    done = subprocess.run(words, cwd=tmp_path, capture_output=True, text=True, timeout=LIMIT, check=False)
    assert done.returncode == 1
    assert len(done.stderr.splitlines()) == 1, done.stderr
    assert done.stderr.startswith(f"{tool}.py: ")
    assert not list(tmp_path.iterdir())


def test_a_demo_without_images_has_nothing_to_reconstruct(tmp_path):
    (tmp_path / "log").mkdir()
    words = [sys.executable, str(TOOLS / "bench_reconstruction.py"), str(tmp_path)]
    done = subprocess.run(words, capture_output=True, text=True, timeout=LIMIT, check=False)
    assert done.returncode == 1
    assert len(done.stderr.splitlines()) == 1
    assert "`objslam demo` without --boxes makes one" in done.stderr
