"""The scripts and the notebook in examples/ run, and print what they promise."""

from __future__ import annotations

import json
import runpy
import shutil
import sys
import tomllib
from collections.abc import Callable
from contextlib import chdir
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from small_log import small_log

from objslam.sources.log_folder import write_log_folder

Play = Callable[..., str]
EXAMPLES = Path(__file__).resolve().parents[2] / "examples"


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a log, its result, and a log that has images of one red thing in place of boxes."""
    at = tmp_path_factory.mktemp("examples")
    log = small_log(missed=0.0, false=0.0)
    write_log_folder(log, at / "log")
    write_log_folder(log, at / "red")
    boxes = log.cameras[0].detections
    assert boxes is not None
    (at / "red" / "detections.jsonl").unlink()
    (at / "red" / "rgb").mkdir()
    lines = []
    for k, stamp in enumerate(boxes.frame_stamps):
        image = np.full((480, 640, 3), 90, dtype=np.uint8)
        mine = boxes.boxes[(boxes.frame == k) & (boxes.label == boxes.label_names.index("cup"))]
        for x1, y1, x2, y2 in mine.round().astype(int):
            cv2.rectangle(image, (x1, y1), (x2 - 1, y2 - 1), (0, 0, 220), -1)
        cv2.imwrite(str(at / "red" / "rgb" / f"{k}.png"), image)
        lines.append(f"{float(stamp)!r} rgb/{k}.png\n")
    (at / "red" / "rgb.txt").write_text("".join(lines))
    return at


@pytest.fixture
def play(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Play:
    """Run a script as Python does, but in this process. Return what it prints."""

    def run(name: str, *arguments: Path) -> str:
        script = str(EXAMPLES / f"{name}.py")
        monkeypatch.setattr(sys, "argv", [script, *map(str, arguments)])
        capsys.readouterr()
        runpy.run_path(script, run_name="__main__")
        return capsys.readouterr().out

    return run


def test_every_example_is_played_here() -> None:
    text = Path(__file__).read_text("utf-8")
    names = sorted(file.stem for file in EXAMPLES.glob("*.py"))
    assert len(names) == 6
    for name in names:
        assert f'play("{name}"' in text


def test_every_example_is_checked_as_strictly_as_a_user_may() -> None:
    project = tomllib.loads((EXAMPLES.parent / "pyproject.toml").read_text("utf-8"))
    (strict,) = [one for one in project["tool"]["mypy"]["overrides"] if "check_untyped_defs" in one]
    assert strict["module"] == sorted(file.stem for file in EXAMPLES.glob("*.py"))


def test_a_folder_becomes_a_result_that_answers(play: Play, folder: Path) -> None:
    said = play("map_folder", folder / "log", folder / "out")
    assert "ObjectMap of 4 objects (0 unresolved)" in said
    answers = play("query_result", folder / "out")
    assert "nearest to the origin: plant" in answers
    assert "cov_xy" in answers


def test_arrays_become_the_cup_of_the_readme(play: Play) -> None:
    assert "cup #0 at (2.510, 0.503, 0.400) m, sigma 0.824 m, 5 rays" in play("from_arrays")


def test_pushed_data_become_a_map(play: Play, folder: Path) -> None:
    assert "ObjectMap of 4 objects (0 unresolved)" in play("live_session", folder / "log")


def test_boxes_of_another_detector_become_a_map(play: Play, folder: Path) -> None:
    said = play("own_detector", folder / "red")
    assert "ObjectMap of 1 object " in said
    place: Any = [float(x) for x in said.split("at (")[1].split(")")[0].split(",")]
    np.testing.assert_allclose(place, (1.0, 0.5, 0.5), atol=0.05)


def test_shared_errors_go_from_one_run_to_the_next(play: Play, folder: Path) -> None:
    said = play("settings_and_calibration", folder / "log", folder / "calibrated")
    assert "odometry.scale: " in said
    assert "ObjectMap of 4 objects (0 unresolved)" in said


def test_the_notebook_runs_from_top_to_bottom(folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Without Jupyter, so a cell must be plain Python."""
    shutil.copytree(folder / "log", tmp_path / "demo_boxes" / "log")
    notebook = json.loads((EXAMPLES / "first_map.ipynb").read_text("utf-8"))
    cells = ["".join(cell["source"]) for cell in notebook["cells"] if cell["cell_type"] == "code"]
    names: dict[str, Any] = {}
    with chdir(tmp_path):
        for cell in cells:
            exec(compile(cell, "cell", "exec"), names)
        picture = eval(cells[-1].splitlines()[-1], names)  # A notebook shows the value of the last line.
    assert min(picture.size) > 300
    assert (tmp_path / "notebook_map" / "objects.json").is_file()
    said = capsys.readouterr().out
    assert "ObjectMap of 4 objects (0 unresolved)" in said
    assert said.count("m in x, y, z;") == 4
    assert "nearest to the origin: plant" in said
    assert not any(cell.get("outputs") for cell in notebook["cells"])  # A stale output would say what is not so.


WITH_ARGUMENTS = sorted(one for one in EXAMPLES.glob("*.py") if "sys.argv" in one.read_text())


@pytest.mark.parametrize("script", WITH_ARGUMENTS, ids=lambda script: script.stem)
def test_wrong_arguments_end_in_a_line_and_no_traceback(script: Path, play: Play, tmp_path: Path) -> None:
    with pytest.raises(SystemExit, match=f"{script.stem}.py"):
        play(script.stem)
    many = script.read_text().split("len(sys.argv) != ")[1][0]
    with pytest.raises(SystemExit, match="nowhere"):
        play(script.stem, *[tmp_path / "nowhere"] * (int(many) - 1))
