"""What a program reads of the commands: --json, --quiet, and usage errors that say what was meant."""

from __future__ import annotations

import json
import re
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest
from commands import Call, call
from quick import NOTHING_DRAWN, QUICK, options
from small_log import small_log

from objslam.sources.log_folder import write_log_folder

Objslam = Callable[..., Call]
LEAN = options(*NOTHING_DRAWN)


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("logs") / "small"
    write_log_folder(small_log(), folder)
    return folder


@pytest.fixture(scope="module")
def run(log: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Call, Path]:
    """A run with default settings, and its folder."""
    out = tmp_path_factory.mktemp("results") / "out"
    return call("run", log, "-o", out, *LEAN), out


def test_a_run_in_json_is_its_files(objslam: Objslam, log: Path, tmp_path: Path) -> None:
    done = objslam("run", log, "-o", tmp_path / "out", "--json", *QUICK)
    assert done.code == 0, done.err
    told = json.loads(done.out)
    assert told["objects"] == json.loads((tmp_path / "out" / "objects.json").read_text())["objects"]
    written = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert told["summary"] == written
    assert told["out"] == str(tmp_path / "out")


def test_a_quiet_run_prints_warnings_only(objslam: Objslam, log: Path, tmp_path: Path) -> None:
    done = objslam("run", log, "-o", tmp_path / "out", "--quiet", *QUICK, "--set", "rays.border=100")
    assert (done.code, done.out) == (0, "")
    assert "warning: dropped" in done.err
    assert "camera left, stamp 1700000" in done.err
    assert (tmp_path / "out" / "summary.json").is_file()


def test_a_run_ends_with_its_verdict(run: tuple[Call, Path]) -> None:
    done, out = run
    lines = done.out.splitlines()
    assert lines[-2].startswith("verdict: good. 4 objects")
    assert lines[-1] == f"wrote {out}"


def test_an_evaluation_in_json_is_its_file(objslam: Objslam, run: tuple[Call, Path]) -> None:
    done, out = run
    assert done.code == 0
    told = json.loads(objslam("eval", out, "--json").out)
    assert told == json.loads((out / "evaluation.json").read_text())
    assert told["matched"] == 4


def test_an_evaluation_and_a_report_may_be_quiet(objslam: Objslam, run: tuple[Call, Path]) -> None:
    _, out = run
    assert objslam("eval", out, "-q").out == ""
    assert (out / "evaluation.json").is_file()
    assert objslam("report", out, "--quiet").out == ""
    assert json.loads(objslam("report", out, "--json").out) == {"wrote": str(out / "report.html")}


def test_a_mount_as_an_option_says_where_it_goes(objslam: Objslam, log: Path) -> None:
    done = objslam("run", log, "--mount=0,0,1,0,0,0")
    assert done.code == 2
    done.says("no --mount", "--camera-info FILE")


def test_images_behind_a_link_are_told_to_who_runs_a_detector(objslam: Objslam, log: Path, tmp_path: Path) -> None:
    shutil.copytree(log, tmp_path / "log")
    (tmp_path / "photos").mkdir()
    (tmp_path / "photos" / "1.png").write_bytes(b"an image")
    (tmp_path / "log" / "rgb").symlink_to(tmp_path / "photos")
    (tmp_path / "log" / "rgb.txt").write_text("1700000000.5 rgb/1.png\n")
    model = Path(__file__).parents[2] / "objslam" / "detection" / "models" / "ssd7.onnx"
    done = objslam("run", tmp_path / "log", "-o", tmp_path / "out", "--detector", model)
    assert done.code == 1
    done.says_somewhere("no camera has rgb images", "behind a link", "copy them into the log")


def test_a_quiet_session_prints_warnings_only(objslam: Objslam, log: Path, tmp_path: Path) -> None:
    done = objslam("live", log, "-o", tmp_path / "out", "--speed", "0", "--quiet", *QUICK, "--set", "rays.border=100")
    assert (done.code, done.out) == (0, "")
    assert all(line.startswith("warning: ") for line in done.err.splitlines())
    assert "warning: dropped" in done.err
    assert (tmp_path / "out" / "summary.json").is_file()


def test_help_is_a_word_too(objslam: Objslam) -> None:
    for words in ((), ("run",), ("config", "dump")):
        assert objslam("help", *words).out == objslam(*words, "--help").out != ""


def test_a_log_that_tells_no_shared_error_has_no_table_of_them(
    objslam: Objslam, run: tuple[Call, Path], log: Path, tmp_path: Path
) -> None:
    told = run[0].out
    assert "prior sigma" in told
    assert "its priors count" not in told
    few = tmp_path / "few"
    shutil.copytree(log, few)
    frames = (log / "detections.jsonl").read_text().splitlines()
    (few / "detections.jsonl").write_text("\n".join(frames[:4]) + "\n")
    told = objslam("run", few, "-o", tmp_path / "out", *LEAN).out
    assert "prior sigma" not in told
    assert "this log shows none of them; the sigmas contain their usual sizes" in told


def test_doctor_shows_an_unusual_calibration_if_there_are_too_few_boxes_to_judge_it(
    objslam: Objslam, log: Path, tmp_path: Path
) -> None:
    few = tmp_path / "few"
    shutil.copytree(log, few)
    frames = (log / "detections.jsonl").read_text().splitlines()
    (few / "detections.jsonl").write_text("\n".join(frames[:4]) + "\n")
    assert objslam("doctor", few).out.splitlines()[-1] == "nothing wrong was found"
    camera = (few / "camera.yaml").read_text()
    camera = re.sub(r"rotation_xyzw: .*", "rotation_xyzw: [0, 0, 0, 1]", camera)
    (few / "camera.yaml").write_text(camera)
    last = objslam("doctor", few).out.splitlines()[-1]
    assert last.startswith("check: ")
    assert "base_T_camera has no rotation" in last


def test_info_tells_in_words_and_in_json(objslam: Objslam, log: Path) -> None:
    words = objslam("info", log).out
    assert "The robot drives 15.5 m in 15.8 s, by odometry and localization." in words
    assert "The camera left has 284 boxes of 4 labels in 80 frames." in words
    told = json.loads(objslam("info", log, "--json").out)
    assert told["kind"] == "log"
    assert told["missing"] == []
    assert told["cameras"][0]["width"] == 640
    assert {stream["role"]: stream["timing"]["count"] for stream in told["streams"]}["detections"] == 80


def test_info_sees_boxes_that_are_fractions(objslam: Objslam, log: Path, tmp_path: Path) -> None:
    write_log_folder(small_log(), tmp_path / "log")
    frames = [json.loads(line) for line in (log / "detections.jsonl").read_text().splitlines()]
    for frame in frames:
        frame["boxes"] = [[x1 / 640, y1 / 480, x2 / 640, y2 / 480] for x1, y1, x2, y2 in frame["boxes"]]
    (tmp_path / "log" / "detections.jsonl").write_text("".join(json.dumps(frame) + "\n" for frame in frames))
    assert "they are probably shares of the image, not px" in objslam("info", tmp_path / "log").err


@pytest.mark.parametrize("factor", [1e3, 1e9])
def test_info_describes_a_log_whose_stamps_are_not_in_seconds(objslam: Objslam, tmp_path: Path, factor: float) -> None:
    poses = "".join(f"{factor * (1.7e9 + 0.1 * i):.0f} {0.05 * i} 0 0\n" for i in range(30))
    write_log_folder(small_log(), tmp_path / "log")
    (tmp_path / "log" / "odometry.txt").unlink()
    (tmp_path / "log" / "localization.txt").write_text(poses)
    frames = "".join(
        json.dumps({"stamp": factor * (1.7e9 + 0.1 * i), "boxes": [[9, 9, 50, 50]], "labels": ["a"], "scores": [1]}) + "\n"
        for i in range(30)
    )
    (tmp_path / "log" / "detections.jsonl").write_text(frames)
    assert "all stamps are probably in" in objslam("info", tmp_path / "log").err


@pytest.mark.parametrize(
    ("arguments", "meant"),
    [
        (("run", "LOG", "--mode", "jont"), "joint"),
        (("eval", "OUT", "--align", "s2"), "se2"),
        (("run", "LOG", "--mode", "x"), ""),
    ],
)
def test_a_mistyped_choice_says_what_is_meant(objslam: Objslam, arguments: tuple[str, ...], meant: str) -> None:
    done = objslam(*arguments)
    assert done.code == 2
    said = " ".join(done.err.replace("│", " ").split())
    assert "is none of" in said
    assert "Value error" not in said
    assert ("did you mean" in said) == bool(meant)
    assert not meant or f"did you mean {meant}?" in said
