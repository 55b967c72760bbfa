"""The table of export formats: what each module declares, and that a new format is one new file."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

import objslam
from objslam.output import result_folder
from objslam.output.export.formats import FORMATS

TOY = '''"""Toy: the number of objects."""

from objslam.output.export.export_format import ExportFormat

EXPORT = ExportFormat("toy", "objects.toy", "how many objects there are", lambda content: b"%d" % len(content.objects))
'''
"""The whole of a new format."""


def test_each_format_has_a_name_a_file_and_a_line_of_help_of_its_own() -> None:
    modules = [file.name for file in Path(result_folder.__file__).parent.glob("export/formats/*_file.py")]
    assert len(FORMATS) == len(modules) == len({known.file for known in FORMATS.values()})
    for name, known in FORMATS.items():
        assert name == known.name
        assert known.help
        assert not known.help.endswith(".")
        assert Path(known.file).name == known.file


def test_a_new_format_is_one_new_file(result: Path, tmp_path: Path) -> None:
    """The format is offered, described in the help, written, and removed by the next run."""
    package, out = tmp_path / "objslam", tmp_path / "out"
    shutil.copytree(Path(objslam.__file__).parent, package, ignore=shutil.ignore_patterns("__pycache__", "models"))
    shutil.copytree(result, out)
    (package / "output" / "export" / "formats" / "toy_file.py").write_text(TOY, encoding="utf-8")
    told = python(tmp_path, "-m", "objslam", "export", "--help")
    assert "toy: how many objects there are." in " ".join(told.replace("\u2502", " ").split())
    assert "objects.toy" in python(tmp_path, "-m", "objslam", "export", str(out), "--to", "toy")
    assert int((out / "objects.toy").read_bytes()) >= 3
    code = (
        "from pathlib import Path; from objslam.output.result_folder import clear_result; print(clear_result(Path('out')))"
    )
    assert "'objects.toy'" in python(tmp_path, "-c", code)
    assert not (out / "objects.toy").exists()


def python(folder: Path, *arguments: str) -> str:
    """What Python prints, run in a folder with the package that lies there."""
    environment = {**os.environ, "PYTHONPATH": str(folder), "COLUMNS": "200"}
    done = subprocess.run([sys.executable, *arguments], cwd=folder, env=environment, capture_output=True, text=True)
    if done.returncode:
        pytest.fail(done.stderr)
    return done.stdout
