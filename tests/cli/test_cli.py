"""The command line as a user meets it: what it prints, what it leaves, and how it fails."""

import json
import os
import random
import re
import shutil
import signal
import subprocess
import sys
import sysconfig
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import yaml
from added_errors import add_shared_errors
from commands import Call, call
from processes import running
from quick import HELD, NOTHING_DRAWN, QUICK, ROUGH, options
from scipy.linalg import block_diag
from small_log import THINGS, small_log
from waiting import LIMIT, pause, wait_for
from wrong_inputs import MISTAKES

from objslam import __version__
from objslam.config import Odometry, Settings
from objslam.core.calibration import Calibration
from objslam.io.calibration_yaml import dump_calibration, load_calibration
from objslam.io.results.read import load_map, load_trajectory
from objslam.simulation import preset, simulate
from objslam.simulation.trajectory import START
from objslam.sources.log_folder import write_log_folder

LEAN = options(*NOTHING_DRAWN)
BY_LABEL = options(*ROUGH, *NOTHING_DRAWN, "association.method=by_label")
CHECKED = (*LEAN, *options("bodies.use=false", "calibration.use=false", "noise.localization=false"))
MODES = ("fixed", "joint")
SCRIPT = Path(sysconfig.get_path("scripts")) / "objslam"


@pytest.fixture(scope="session")
def log_folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("logs") / "small"
    write_log_folder(small_log(), folder)
    return folder


@pytest.fixture(scope="module")
def whole_result(log_folder, tmp_path_factory):
    """What `run` writes."""
    out = tmp_path_factory.mktemp("results") / "out"
    assert call("run", log_folder, "-o", out, *QUICK).code == 0
    return out


@pytest.fixture
def out(whole_result, tmp_path):
    """A copy of the result to be evaluated, or spoilt."""
    return Path(shutil.copytree(whole_result, tmp_path / "out"))


@pytest.fixture
def variant(log_folder, tmp_path):
    """A copy of the log to be spoilt."""
    return Path(shutil.copytree(log_folder, tmp_path / "log"))


def in_process_of_its_own(*arguments) -> Call:
    done = subprocess.run([SCRIPT, *map(str, arguments)], capture_output=True, text=True, timeout=LIMIT, check=False)
    return Call(done.returncode, done.stdout, done.stderr)


def rewrite(file: Path, change) -> None:
    """Every line but comments through change(number, line), None leaves a line out."""
    lines = [line for line in file.read_text().splitlines() if not line.startswith("#")]
    changed = [change(i, line) for i, line in enumerate(lines)]
    file.write_text("".join(f"{line}\n" for line in changed if line is not None))


def rewrite_frames(folder: Path, change) -> None:
    def on_line(i, line):
        frame = change(i, json.loads(line))
        return None if frame is None else json.dumps(frame)

    rewrite(folder / "detections.jsonl", on_line)


def both_paths(folder: Path):
    return folder / "odometry.txt", folder / "localization.txt"


def summary(out: Path) -> dict:
    return json.loads((out / "summary.json").read_text())


# What it is for


def test_the_console_script_runs_evaluates_and_leaves_a_whole_result(log_folder, tmp_path):
    out = tmp_path / "deep" / "out"
    run = in_process_of_its_own("run", log_folder, "-o", out, "--set", "calibration.use=false")
    assert run.code == 0, run.err
    assert "tall chair" in run.out
    assert "4 objects from" in run.out
    names = {
        "objects.json",
        "trajectory.txt",
        "path.txt",
        "rays.parquet",
        "views.parquet",
        "doubts.json",
        "summary.json",
        "config.yaml",
        "map.png",
        "recording.rrd",
    }
    assert names | {"groundtruth_objects.json", "groundtruth_trajectory.txt"} == {f.name for f in out.iterdir()}
    assert all(f.stat().st_size > 0 for f in out.iterdir())
    evaluated = in_process_of_its_own("eval", out)
    assert evaluated.code == 0, evaluated.err
    assert "position RMSE" in evaluated.out
    found = json.loads((out / "evaluation.json").read_text())
    assert (found["matched"], found["missed"], found["false"]) == (4, 0, 0)
    assert found["position_max"] < 0.03
    assert found["ate"] < 0.04


@pytest.mark.parametrize("mode", MODES)
def test_a_run_finds_the_things(mode, objslam, log_folder, tmp_path):
    run = objslam("run", log_folder, "-o", tmp_path, "--mode", mode, *LEAN)
    assert run.code == 0
    place = {o.label: o.position for o in load_map(tmp_path).objects}
    assert place.keys() == {label for label, _ in THINGS}
    for label, position in THINGS:
        assert np.linalg.norm(place[label] - position) < 0.05
    counts = summary(tmp_path)["counts"]
    assert counts["objects"] == 4
    assert counts["keyframes"] == len(load_trajectory(tmp_path)) == 80
    assert yaml.safe_load((tmp_path / "config.yaml").read_text())["mode"] == mode
    assert f"{mode} mode" in run.out


def test_settings_come_from_file_then_set_then_mode(objslam, log_folder, tmp_path):
    config = tmp_path / "mine.yaml"
    config.write_text(
        "mode: joint\nrays: {pixel_sigma: 2.5}\njoint: {loss: cauchy}\noutput: {recording: false, picture: false}\n"
    )
    assert (
        objslam("run", log_folder, "-o", tmp_path / "out", "--config", config, *options("joint.loss=gnc", *HELD)).code == 0
    )
    told = yaml.safe_load((tmp_path / "out" / "config.yaml").read_text())
    assert (told["mode"], told["rays"]["pixel_sigma"], told["joint"]["loss"]) == ("joint", 2.5, "gnc")
    # what a run wrote is what another can be run with
    again = objslam("run", log_folder, "-o", tmp_path / "again", "--config", tmp_path / "out" / "config.yaml")
    assert again.code == 0
    assert (tmp_path / "again" / "objects.json").read_bytes() == (tmp_path / "out" / "objects.json").read_bytes()


def test_a_converted_log_gives_the_same_map(objslam, log_folder, tmp_path):
    converted = objslam("convert", log_folder, tmp_path / "copy")
    assert converted.code == 0
    assert "wrote" in converted.out
    for log, out in ((log_folder, "a"), (tmp_path / "copy", "b")):
        assert objslam("run", log, "-o", tmp_path / out, *QUICK).code == 0
    a, b = (load_map(tmp_path / out).objects for out in "ab")
    assert [(o.label, o.rays, o.status) for o in a] == [(o.label, o.rays, o.status) for o in b]
    for mine, its in zip(a, b, strict=True):  # rotations are quaternions on disk, which round differently once more
        np.testing.assert_allclose(mine.position, its.position, atol=1e-9)
        np.testing.assert_allclose(mine.covariance, its.covariance, rtol=1e-6, atol=1e-12)


def test_convert_never_writes_over_anything_unasked(objslam, log_folder, variant, tmp_path):
    objslam("convert", log_folder, variant).says("log", "already")
    assert objslam("convert", log_folder, variant, "--overwrite").code == 0
    (tmp_path / "file").write_text("x")
    failed = objslam("convert", log_folder, tmp_path / "file", "--overwrite")
    failed.says("in the way")
    assert failed.code == 1
    (tmp_path / "photos").mkdir()
    (tmp_path / "photos" / "a.jpg").write_text("x")
    objslam("convert", log_folder, tmp_path / "photos", "--overwrite").says("not a log")


def test_info_of_a_log_folder(objslam, log_folder, variant):
    info = objslam("info", log_folder)
    assert (info.code, info.err) == (0, "")
    for words in ("small: log", "odometry", "detections", "640x480", "nothing is missing for a run"):
        assert words in info.out
    (variant / "detections.jsonl").unlink()
    assert "neither detections nor images" in objslam("info", variant).out


def test_info_says_how_boxes_of_a_distorted_camera_are_taken(objslam, variant):
    assert "raw images" not in objslam("info", variant).out
    camera = yaml.safe_load((variant / "camera.yaml").read_text())
    camera["distortion_coefficients"] = [-0.3, 0.1, 0, 0, 0]
    (variant / "camera.yaml").write_text(yaml.safe_dump(camera))
    assert "its boxes are taken as those of raw images" in objslam("info", variant).out


def test_config_dump_is_what_config_reads(objslam, tmp_path):
    dumped = objslam("config", "dump", "--set", "joint.loss=l1", "--set", "poses.max_gap=3")
    assert dumped.code == 0
    file = tmp_path / "all.yaml"
    file.write_text(dumped.out)
    assert objslam("config", "dump", "--config", file).out == dumped.out
    told = yaml.safe_load(dumped.out)
    assert (told["joint"]["loss"], told["poses"]["max_gap"]) == ("l1", 3.0)
    assert Settings.model_validate(yaml.safe_load(objslam("config", "dump").out)) == Settings()


def test_eval_takes_the_truth_from_where_it_is_told(objslam, log_folder, out):
    values = []
    for truth in (log_folder, log_folder / "groundtruth", log_folder / "groundtruth" / "objects.json"):
        assert objslam("eval", out, "--truth", truth, "--align", "se2", "--radius", "0.3").code == 0
        found = json.loads((out / "evaluation.json").read_text())
        assert (found["align"], found["radius"], found["matched"]) == ("se2", 0.3, 4)
        values.append(found["position_rmse"])
    assert values[0] == pytest.approx(values[1])
    assert (json.loads((out / "evaluation.json").read_text())["ate"]) is None  # objects.json has no path


# How it answers at once


@pytest.mark.parametrize(
    "command",
    [
        (),
        ("run",),
        ("eval",),
        ("demo",),
        ("convert",),
        ("info",),
        ("export",),
        ("explain",),
        ("config",),
        ("config", "dump"),
    ],
)
def test_help(objslam, command):
    help_ = objslam(*command, "--help")
    assert help_.code == 0
    assert "Usage" in help_.out
    assert not help_.err


def test_no_arguments_show_help_and_the_version_is_told(objslam):
    bare = objslam()
    assert "Commands" in bare.out
    assert bare.code == 2
    version = objslam("--version")
    assert (version.code, version.out) == (0, f"objslam {__version__}\n")
    assert in_process_of_its_own("--version").out == version.out
    module = subprocess.run(
        [sys.executable, "-m", "objslam", "--version"], capture_output=True, text=True, timeout=LIMIT, check=True
    )
    assert module.stdout == version.out


def imported_by(*arguments: str, depth: int = 2) -> set[str]:
    """The packages that a command imports, and their parts such as scipy.spatial, in a process of its own."""
    code = (
        "import sys\n"
        "from objslam.cli import main\n"
        f"sys.argv = ['objslam', *{arguments!r}]\n"
        "try:\n    main()\nexcept SystemExit as end:\n    assert end.code == 0, end.code\n"
        f"print('modules:', *sorted(name for name in sys.modules if name.count('.') < {depth}))\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=LIMIT, check=True)
    return set(done.stdout.splitlines()[-1].split()[1:])


@pytest.mark.parametrize(
    ("asked", "found"),
    [({}, "1"), ({"OPENBLAS_NUM_THREADS": "3"}, "3"), ({"OMP_NUM_THREADS": "2"}, None)],
)
def test_a_command_has_one_thread_for_matrices_unless_the_user_asks_for_more(objslam, monkeypatch, asked, found):
    for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
        monkeypatch.setenv(name, "")  # So that what the command sets is gone after the test.
        monkeypatch.delenv(name)
    for name, value in asked.items():
        monkeypatch.setenv(name, value)
    assert objslam("--version").code == 0
    assert os.environ.get("OPENBLAS_NUM_THREADS") == found


def test_numpy_is_imported_after_the_number_of_its_threads_is_set():
    code = "import sys; import objslam.cli; sys.exit('numpy' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


@pytest.mark.parametrize(
    "arguments",
    [
        ("--help",),
        *((name, "--help") for name in ("run", "convert", "info", "live", "export", "explain")),
        ("config", "dump"),
        ("--version",),
    ],
)
def test_answers_import_nothing_heavy(arguments):
    """Sources declare their options where nothing heavy is imported: see the head of `objslam/sources/options.py`."""
    heavy = {"torch", "gtsam", "open3d", "onnxruntime", "rerun", "cv2", "matplotlib", "scipy", "pyarrow", "numpy"}
    heavy |= {"rosbags", "mcap", "cyclonedds"}
    light_answer = heavy if arguments != ("config", "dump") else heavy - {"numpy"}
    assert not imported_by(*arguments) & light_answer


def test_a_run_imports_what_it_uses(log_folder, tmp_path):
    lean = imported_by("run", str(log_folder), "-o", str(tmp_path / "lean"), *LEAN)
    assert "gtsam" in lean
    assert not lean & {"torch", "open3d", "onnxruntime", "rerun", "matplotlib", "cv2", "scipy.spatial", "scipy.special"}


def test_the_fixed_mode_loads_nothing_of_the_joint_mode(log_folder, tmp_path):
    loaded = imported_by("run", str(log_folder), "-o", str(tmp_path / "out"), "--mode", "fixed", *LEAN, depth=3)
    assert "objslam.mapping.alternation" in loaded
    assert not loaded & {"objslam.mapping.joint_solve", "objslam.mapping.reconstruction"}


def test_a_command_does_not_load_the_others():
    loaded = imported_by("--debug", "config", "dump", depth=3)
    assert "objslam.cli.config" in loaded
    assert not loaded & {"objslam.cli.run", "objslam.cli.journal", "objslam.live"}
    assert {"objslam.cli.run", "objslam.cli.journal"} <= imported_by("--help", depth=3)


def test_no_object_is_searched_at_the_exit():
    """Python searches all objects that its collector knows once more at its exit. The commands leave it none."""
    script = """
import atexit, gc, sys
kept = [[i] for i in range(100_000)]
atexit.register(lambda: print("searched", len(gc.get_objects())))
from objslam.cli import main
sys.argv = ["objslam", "--version"]
main()
"""
    told = subprocess.run([sys.executable, "-c", script], timeout=LIMIT, check=True, capture_output=True, text=True).stdout
    assert int(told.split("searched")[1]) < 1000


# How it fails: 2 for wrong use


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("--set", "nosuch.thing=1"), ("nosuch.thing=1", "no setting", "config dump")),
        (("--set", "joint.nosuch=1"), ("joint.nosuch",)),
        (("--set", "joint.loss"), ("not key=value",)),
        (("--set", "joint.loss=quadratic"), ("joint.loss", "quadratic")),
        (("--set", "seed=abc"), ("seed", "integer")),
        (("--set", "poses.max_gap=-1"), ("poses.max_gap", "greater than 0")),
        (("--set", "rays=[1"), ("not YAML",)),
        (("--config", "no_such.yaml"), ("no_such.yaml", "no such file", "odometry, paper")),
        (("--format", "vhs"), ("vhs", "mrclam")),
    ],
)
def test_wrong_settings_are_wrong_use(objslam, log_folder, tmp_path, arguments, words):
    failed = objslam("run", log_folder, "-o", tmp_path, *arguments)
    assert failed.code == 2
    failed.says(*words)
    assert not failed.out
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("arguments", "word"),
    [
        (("run",), "Missing argument"),
        (("run", "x", "--mode", "both"), "--mode"),
        (("run", "x", "--nosuch"), "--nosuch"),
        (("run", "x", "--robot", "two"), "--robot"),
        (("eval", "x", "--align", "so3"), "--align"),
        (("eval", "x", "--radius", "-1"), "--radius"),
        (("convert", "x"), "Missing argument"),
        (("demo", "--seed", "-1"), "--seed"),
        (("config", "nosuch"), "nosuch"),
        (("nosuch",), "nosuch"),
    ],
)
def test_wrong_arguments_are_wrong_use(objslam, tmp_path, monkeypatch, arguments, word):
    monkeypatch.chdir(tmp_path)
    failed = objslam(*arguments)
    assert failed.code == 2
    failed.says_somewhere(word, "Usage")
    assert not list(tmp_path.iterdir())


# and 1 for work that cannot be done


@pytest.mark.parametrize("command", ["run", "convert"])
@pytest.mark.parametrize(("name", "word"), [("nowhere", "No such file"), ("empty", "nothing here that objslam reads")])
def test_no_log_there(objslam, tmp_path, command, name, word):
    (tmp_path / "empty").mkdir()
    failed = objslam(*((command, tmp_path / name) + (("-o",) if command == "run" else ()) + (tmp_path / "new" / "out",)))
    assert failed.code == 1
    failed.says(name, word)
    assert not (tmp_path / "new").exists()


def without_path(folder):
    for file in both_paths(folder):
        file.unlink()


def without_detections(folder):
    (folder / "detections.jsonl").unlink()


def with_empty_detections(folder):
    (folder / "detections.jsonl").write_text("\n")


def without_boxes(folder):
    rewrite_frames(folder, lambda i, frame: {"stamp": frame["stamp"], "boxes": [], "labels": [], "scores": []})


def all_before_the_path(folder):
    rewrite_frames(folder, lambda i, frame: {**frame, "stamp": frame["stamp"] - 1000})


def all_after_the_path(folder):
    rewrite_frames(folder, lambda i, frame: {**frame, "stamp": frame["stamp"] + 1000})


def with_nothing_but_nan_poses(folder):
    for file in both_paths(folder):
        rewrite(file, lambda i, line: line.split()[0] + " nan nan 0 0 0 0 1")


def with_half_a_camera(folder):
    (folder / "camera.yaml").write_text("image_width: 640\n")


def with_a_camera_that_is_no_yaml(folder):
    (folder / "camera.yaml").write_text("image_width: {640\n")


def with_an_unknown_lens(folder):
    file = folder / "camera.yaml"
    file.write_text(file.read_text().replace("plumb_bob", "tilted"))


def with_every_label_a_list(folder):
    rewrite_frames(folder, lambda i, frame: {**frame, "labels": [["cup"]] * len(frame["labels"])})


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize(
    ("spoil", "words"),
    [
        (without_path, ("odometry.txt", "localization.txt")),
        (without_detections, ("no detection", "detections.jsonl")),
        (with_empty_detections, ("detections.jsonl", "no detection frame")),
        (without_boxes, ("no box gives a usable ray",)),
        (all_before_the_path, ("none of the 80 detection frames lies on the robot's path", "same clock")),
        (all_after_the_path, ("none of the 80 detection frames lies on the robot's path", "same clock")),
        (with_nothing_but_nan_poses, (".txt", "none of its", "usable")),
        (with_half_a_camera, ("camera.yaml", "image_height is missing")),
        (with_a_camera_that_is_no_yaml, ("camera.yaml:", "not YAML")),
        (with_an_unknown_lens, ("camera.yaml:", "tilted", "plumb_bob")),
        (with_every_label_a_list, ("no box gives a usable ray", "no printable text")),
    ],
)
def test_a_log_that_cannot_be_mapped(objslam, variant, tmp_path, mode, spoil, words):
    spoil(variant)
    failed = objslam("run", variant, "-o", tmp_path / "out", "--mode", mode, *LEAN)
    assert failed.code == 1
    failed.says(*words)
    assert not (tmp_path / "out" / "summary.json").exists()


def with_a_few_nan_poses(folder):
    for file in both_paths(folder):
        rewrite(file, lambda i, line: line.split()[0] + " nan 0 0 0 0 0 1" if i in (20, 30) else line)


def with_stamps_going_back(folder):
    for file in both_paths(folder):
        lines = file.read_text().splitlines()
        lines[60:64] = lines[40:44]
        file.write_text("\n".join(lines))
    frames = (folder / "detections.jsonl").read_text().splitlines()
    frames[30] = frames[3]
    (folder / "detections.jsonl").write_text("\n".join(frames))


def with_labels_of_unknown_type(folder):
    odd = {3: 5.5, 6: None, 7: ["cup"], 9: {"name": "cup"}}
    rewrite_frames(folder, lambda i, frame: {**frame, "labels": [odd[i]] * len(frame["labels"])} if i in odd else frame)


def with_the_camera_of_another_size(folder):
    file = folder / "camera.yaml"
    file.write_text(file.read_text().replace("image_width: 640", "image_width: 400"))


def with_a_path_that_begins_late(folder):
    for file in both_paths(folder):
        rewrite(file, lambda i, line: line if float(line.split()[0]) > START + 4.1 else None)


def with_boxes_that_are_none(folder):
    inside_out, infinite = [300, 300, 200, 200], [1e400, 0, 10, 10]
    rewrite_frames(
        folder,
        lambda i, frame: (
            {**frame, "boxes": [inside_out if i == 4 else infinite] * len(frame["boxes"])} if i in (4, 5) else frame
        ),
    )


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize(
    ("spoil", "words"),
    [
        (with_a_few_nan_poses, ("pose line with a value that is not finite", "odometry.txt:21")),
        (with_stamps_going_back, ("stamp that repeats or goes back", "odometry.txt:61", "detections.jsonl:31")),
        (with_labels_of_unknown_type, ("label that is no printable text", "detections.jsonl:4")),
        (with_a_path_that_begins_late, ("before or after the localisation", f"stamp {START:.3f}")),
        (with_boxes_that_are_none, ("detections.jsonl:5", "detections.jsonl:6")),
    ],
)
def test_what_is_spoilt_is_counted_and_the_rest_is_mapped(objslam, variant, tmp_path, mode, spoil, words):
    spoil(variant)
    run = objslam("run", variant, "-o", tmp_path / "out", "--mode", mode, *CHECKED)
    assert run.code == 0, run.err
    run.says_somewhere("warning: dropped", *words)
    told = summary(tmp_path / "out")
    assert told["dropped"]
    assert all(f"dropped {count}: {reason}" in run.err for reason, count in told["dropped"].items())
    resolved = load_map(tmp_path / "out").resolved()
    assert len(resolved) >= 3
    for o in resolved:
        assert np.linalg.norm(o.position - dict(THINGS)[o.label]) < 0.3


@pytest.mark.parametrize("mode", MODES)
def test_a_camera_of_another_size_is_said_and_nothing_is_sure(objslam, variant, tmp_path, mode):
    with_the_camera_of_another_size(variant)
    run = objslam("run", variant, "-o", tmp_path / "out", "--mode", mode, *LEAN)
    assert run.code == 0, run.err
    run.says_somewhere("warning: dropped", "outside the image", "camera left")
    run.says_somewhere("the input")
    assert not load_map(tmp_path / "out").resolved()
    objslam("run", variant, "-o", tmp_path / "all", "--mode", mode, *QUICK)
    resolved = load_map(tmp_path / "all").resolved()
    assert len(resolved) >= 3
    assert all(np.linalg.norm(o.position - dict(THINGS)[o.label]) < 0.3 for o in resolved)


def only_first_cup(folder, count):
    kept = []

    def change(i, frame):
        if "cup" not in frame["labels"] or len(kept) == count:
            return None
        kept.append(i)
        at = frame["labels"].index("cup")
        return {"stamp": frame["stamp"], **{name: [frame[name][at]] for name in ("boxes", "labels", "scores")}}

    rewrite_frames(folder, change)


def exactly_one_ray(folder):
    only_first_cup(folder, 1)


def parallel_rays(folder):
    for file in both_paths(folder):
        rewrite(file, lambda i, line: f"{line.split()[0]} {0.002 * i} 0 0 0 0 0 1")
    box = {"boxes": [[300, 200, 340, 240]], "labels": ["cup"], "scores": [0.9]}
    rewrite_frames(folder, lambda i, frame: {"stamp": frame["stamp"], **box} if i < 30 else None)


def a_robot_that_stands(folder):
    for file in both_paths(folder):
        rewrite(file, lambda i, line: f"{line.split()[0]} 1 2 0 0 0 0 1")


def a_path_of_one_pose(folder):
    for file in both_paths(folder):
        rewrite(file, lambda i, line: line if i == 0 else None)


def a_single_frame(folder):
    rewrite_frames(folder, lambda i, frame: frame if i == 0 else None)


SPOILS = [exactly_one_ray, parallel_rays, a_robot_that_stands, a_path_of_one_pose, a_single_frame]
PATHS = ["both", "odometry.txt", "localization.txt"]


@pytest.mark.parametrize(
    ("spoil", "paths", "mode"),
    [
        (spoil, paths, MODES[(i + k) % 2])  # Each two of the three meet in some case.
        for i, spoil in enumerate(SPOILS)
        for k, paths in enumerate(PATHS)
    ],
)
def test_rays_that_place_nothing_place_nothing(objslam, variant, tmp_path, mode, paths, spoil):
    spoil(variant)
    for file in both_paths(variant):
        if paths not in ("both", file.name):
            file.unlink()
    run = objslam("run", variant, "-o", tmp_path / "out", "--mode", mode, *LEAN)
    assert run.code == 0, run.err
    run.says_somewhere()
    found = load_map(tmp_path / "out")
    assert not found.resolved()
    told = summary(tmp_path / "out")
    unexplained = told["counts"]["rays_unexplained"]
    assert found.objects or unexplained == told["counts"]["rays"]  # with its ray, or counted
    assert not unexplained or "no object at rest explains" in run.err
    for o in found.objects:
        assert o.ray is not None
        assert o.covariance is None
    evaluated = objslam("eval", tmp_path / "out")
    assert evaluated.code == 0, evaluated.err


def test_options_of_another_source_are_named(objslam, log_folder, tmp_path):
    run = objslam("run", log_folder, "-o", tmp_path, "--robot", 3, "--anonymous", *QUICK)
    assert run.code == 0
    run.says_somewhere("--robot has no meaning", "--anonymous has no meaning")


# Results that cannot be written or read


def test_a_file_in_the_way_of_the_output(objslam, log_folder, tmp_path):
    file = tmp_path / "file"
    file.write_text("mine")
    for out in (file, file / "below"):
        failed = objslam("run", log_folder, "-o", out, *QUICK)
        assert failed.code == 1
        failed.says("file")
    assert file.read_text() == "mine"
    (tmp_path / "out" / "objects.json").mkdir(parents=True)
    failed = objslam("run", log_folder, "-o", tmp_path / "out", *QUICK)
    assert failed.code == 1
    failed.says("objects.json")


def test_files_of_others_in_the_folder_of_a_result_are_named_once(objslam, log_folder, tmp_path):
    out = tmp_path / "out"
    out.mkdir()
    (out / "notes.txt").write_text("mine")
    first = objslam("run", log_folder, "-o", out, *QUICK)
    assert first.code == 0
    assert f"warning: {out} holds other files (notes.txt)" in first.err
    again = objslam("run", log_folder, "-o", out, *QUICK)
    assert again.code == 0
    assert "holds other files" not in again.err
    assert (out / "notes.txt").read_text() == "mine"


def test_an_output_on_a_drive_that_is_not_there(objslam, log_folder):
    failed = objslam("run", log_folder, "-o", "/proc/no_such_drive/out", *QUICK)
    assert failed.code == 1
    failed.says("/proc/no_such_drive", "cannot write")


@pytest.mark.skipif(os.geteuid() == 0, reason="root writes everywhere")
def test_a_folder_that_may_not_be_written(objslam, log_folder, tmp_path):
    tmp_path.chmod(0o500)
    try:
        failed = objslam("run", log_folder, "-o", tmp_path / "out", *QUICK)
        assert failed.code == 1
        failed.says("Permission denied")
    finally:
        tmp_path.chmod(0o700)


def test_a_log_is_never_taken_for_the_place_of_its_result(objslam, variant, monkeypatch):
    before = {file: file.read_bytes() for file in variant.rglob("*") if file.is_file()}
    for out in (str(variant), "."):
        monkeypatch.chdir(variant)
        failed = objslam("run", variant, "-o", out, *QUICK)
        assert failed.code == 1
        failed.says("this is a log", "-o")
        assert {file: file.read_bytes() for file in variant.rglob("*") if file.is_file()} == before


def test_what_went_with_the_older_result_is_told(objslam, variant, tmp_path):
    out = tmp_path / "out"
    assert "removed" not in objslam("run", variant, "-o", out, *QUICK).out
    assert objslam("export", out, "--to", "csv").code == 0
    assert objslam("eval", out).code == 0
    told = objslam("run", variant, "-o", out, *QUICK).out
    assert f"removed the older result from {out}: evaluation.json, objects.csv" in told


def test_truth_that_is_missing_in_eval(objslam, variant, tmp_path):
    shutil.rmtree(variant / "groundtruth")
    assert objslam("run", variant, "-o", tmp_path / "out", *QUICK).code == 0
    failed = objslam("eval", tmp_path / "out")
    assert failed.code == 1
    failed.says(str(tmp_path / "out"), "no ground truth", "--truth")
    for truth in (tmp_path / "nowhere.json", variant):
        failed = objslam("eval", tmp_path / "out", "--truth", truth)
        assert failed.code == 1
        failed.says("ground truth")
    assert objslam("eval", tmp_path / "nowhere").code == 1
    failed = objslam("eval", tmp_path / "out", "--radius", "0")
    assert failed.code == 2
    failed.says("radius")


@pytest.mark.parametrize(
    ("name", "content", "word"),
    [
        ("objects.json", b"{", "not JSON"),
        ("objects.json", b"[]", "not an objects file"),
        ("objects.json", b"\xff\xfe", "not UTF-8 text"),
        ("objects.json", None, "missing"),
        ("trajectory.txt", b"hello\n", "a pose line is stamp tx ty tz"),
        ("trajectory.txt", None, "missing"),
        ("groundtruth_objects.json", b'{"objects": [{"id": 1}]}', "objects[0]"),
        ("groundtruth_trajectory.txt", b"", "nothing in it"),
    ],
)
def test_a_corrupted_result_in_eval(objslam, out, name, content, word):
    if content is None:
        (out / name).unlink()
    else:
        (out / name).write_bytes(content)
    failed = objslam("eval", out)
    assert failed.code == 1
    failed.says(name, word)
    assert not (out / "evaluation.json").exists()


# The last resorts


def test_debug_shows_the_traceback_of_an_error(log_folder, tmp_path):
    failed = in_process_of_its_own("--debug", "run", tmp_path / "nowhere", "-o", tmp_path / "out")
    assert failed.code == 1
    assert "Traceback" in failed.err
    assert "LogError" in failed.err
    quiet = in_process_of_its_own("run", tmp_path / "nowhere", "-o", tmp_path / "out")
    assert quiet.code == 1
    quiet.says("nowhere")


def test_an_unforeseen_error_asks_for_a_report(objslam, log_folder, tmp_path, monkeypatch):
    def broken(*_):
        raise ZeroDivisionError("a fault of ours")

    monkeypatch.setattr("objslam.mapping.pipeline.run", broken)
    failed = objslam("run", log_folder, "-o", tmp_path, *QUICK)
    assert failed.code == 1
    assert failed.err == (
        "objslam: internal error, ZeroDivisionError: a fault of ours "
        "(please report it with the traceback from objslam --debug)\n"
    )
    monkeypatch.setattr("objslam.mapping.pipeline.run", lambda *_: exhausted())
    failed = objslam("run", log_folder, "-o", tmp_path, *QUICK)
    assert failed.code == 1
    failed.says("out of memory")


def exhausted():
    raise MemoryError


ENDLESS = """
from objslam.mapping import pipeline
from objslam.cli import main

run = pipeline.run

def again_and_again(*work):
    print("begun", flush=True)
    while True:
        run(*work)

pipeline.run = again_and_again
main()
"""


def test_an_interrupt_ends_a_run_without_a_traceback(log_folder, tmp_path):
    """In the middle of the work, however fast that is."""
    out = tmp_path / "out"
    command = [sys.executable, "-c", ENDLESS, "run", str(log_folder), "-o", str(out), *LEAN]
    with running(command, stderr=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as run:
        assert run.stdout.readline() == "begun\n"
        run.send_signal(signal.SIGINT)
        _, err = run.communicate(timeout=LIMIT)
    assert run.returncode == 130
    assert "Traceback" not in err
    assert not (out / "summary.json").exists()


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP])
def test_a_run_that_is_ended_from_outside_leaves_nothing_half(log_folder, tmp_path, number):
    out = tmp_path / "out"
    command = [sys.executable, "-c", ENDLESS, "run", str(log_folder), "-o", str(out), *LEAN]
    heard = partial(signal.signal, number, signal.SIG_DFL)  # Under nohup, the suite and its children ignore SIGHUP.
    with running(command, stderr=subprocess.PIPE, stdout=subprocess.PIPE, text=True, preexec_fn=heard) as run:
        assert run.stdout.readline() == "begun\n"
        run.send_signal(number)
        _, err = run.communicate(timeout=LIMIT)
    assert run.returncode in (-number, 128 + number)
    assert len(err.splitlines()) <= 1
    assert "Traceback" not in err
    assert not out.exists() or not list(out.iterdir())


@pytest.mark.parametrize("command", ["info", "info --json", "run --json"])
def test_a_reader_that_leaves_early_is_no_traceback(log_folder, tmp_path, command):
    """The pipe is closed before the first line, so the command cannot write at all."""
    read_end, write_end = os.pipe()
    os.close(read_end)
    more = ("-o", str(tmp_path / "out"), *QUICK) if command.startswith("run") else ()
    words = [SCRIPT, *command.split()[:1], str(log_folder), *command.split()[1:], *more]
    done = subprocess.run(words, stdout=write_end, stderr=subprocess.PIPE, text=True, timeout=LIMIT, check=False)
    os.close(write_end)
    assert done.returncode in (0, 1, -signal.SIGPIPE)
    assert "Traceback" not in done.stderr
    assert "internal error" not in done.stderr
    assert "Exception ignored" not in done.stderr
    if more:
        assert summary(tmp_path / "out")["counts"]["objects"] == 4


def test_a_closed_pipe_is_no_traceback():
    run = subprocess.run(
        f"'{SCRIPT}' config dump | head -n 1", shell=True, capture_output=True, text=True, timeout=LIMIT, check=False
    )
    assert run.stdout.startswith("mode:")
    assert "Traceback" not in run.stderr


def test_a_killed_run_leaves_no_half_result(log_folder, tmp_path, objslam):
    """Killed at random moments, most of them while it writes: no summary.json, or a whole result, the old or the new one."""
    out, rng = tmp_path / "out", random.Random(0)
    held = options(*HELD)
    assert objslam("run", log_folder, "-o", out, *held, "--set", "output.recording=false").code == 0
    before = (out / "objects.json").read_bytes()
    killed = attempt = 0
    while killed < 5:  # a run may be done before
        command = [SCRIPT, "run", str(log_folder), "-o", str(out), *held, "--set", f"seed={attempt + 1}", "--mode", "joint"]
        staged = out / ".objslam-staging"
        with running(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL) as run:
            if attempt:
                writing = [staged / "objects.json", staged / "map.png"]
                wait_for(lambda run=run, writing=writing: run.poll() is not None or any(f.exists() for f in writing), 0.001)
            pause(rng.uniform(0, 0.6 if attempt % 2 else 0.1))
            attempt += 1
            assert attempt < 100
            killed += run.poll() is None
        if (out / "summary.json").exists():
            found = load_map(out)
            assert summary(out)["counts"]["objects"] == len(found) == 4
            assert len(load_trajectory(out)) == 80
            told = yaml.safe_load((out / "config.yaml").read_text())
            assert summary(out)["mode"] == told["mode"]
            assert (told["mode"] == "fixed") == ((out / "objects.json").read_bytes() == before)
    # And the next run is whole.
    assert objslam("run", log_folder, "-o", out, *held, "--set", "output.recording=false").code == 0
    assert (out / "objects.json").read_bytes() == before
    assert not (out / ".objslam-staging").exists()


def test_a_camera_without_a_picture_of_its_own_is_left_to_others(objslam, tmp_path):
    """Two cameras of which one saw nothing at all."""
    log = small_log()
    (camera_log,) = log.cameras
    blind = replace(camera_log, camera=replace(camera_log.camera, name="right"), detections=None)
    write_log_folder(replace(log, cameras=(camera_log, blind)), tmp_path / "log")
    assert objslam("run", tmp_path / "log", "-o", tmp_path / "out", *QUICK).code == 0
    assert len(load_map(tmp_path / "out").resolved()) == 4


def test_calibrate_and_run_with_what_it_found(objslam, tmp_path):
    drives = []
    for seed in (1, 2):
        log = simulate(preset("demo", classes=12, frames=200, localization=None, odometry=Odometry()), seed)
        write_log_folder(add_shared_errors(log, {"front.clock": 0.15}), tmp_path / f"log{seed}")
        drives.append(str(tmp_path / f"log{seed}"))
    file, fast = tmp_path / "robot.yaml", BY_LABEL
    done = objslam("calibrate", *drives, "-o", str(file), *fast)
    assert done.code == 0, done.err
    assert "from 2 logs" in done.out
    found = load_calibration(file)
    clock = found.names.index("front.clock")
    assert abs(found.values[clock] - 0.15) < 4 * found.sigma[clock]
    done = objslam("run", drives[0], "--mode", "joint", "--calibration", str(file), "-o", str(tmp_path / "out"), *fast)
    assert done.code == 0, done.err
    parameters = json.loads((tmp_path / "out" / "summary.json").read_text())["calibration"]["parameters"]
    assert parameters["front.clock"]["prior_sigma"] == pytest.approx(found.sigma[clock], rel=1e-6)
    assert "front.clock" in done.out


@pytest.fixture(scope="module")
def late_camera(tmp_path_factory):
    """A short drive without an error of the odometry, whose camera clock is 0.15 s off."""
    log = simulate(preset("demo", objects=8, classes=8, frames=120, localization=None, odometry=Odometry()), 1)
    folder = tmp_path_factory.mktemp("logs") / "late"
    write_log_folder(add_shared_errors(log, {"front.clock": 0.15}), folder)
    return folder


def test_calibrate_leaves_out_a_log_that_it_cannot_use(objslam, tmp_path, late_camera):
    file = tmp_path / "robot.yaml"
    logs = (str(tmp_path / "none"), str(late_camera))
    done = objslam("calibrate", *logs, "-o", str(file), *BY_LABEL)
    assert done.code == 0, done.err
    done.says_somewhere("warning:", "none is left out")
    assert "from 1 log (1 left out)" in done.out
    assert load_calibration(file).names


def test_calibrate_fails_if_no_log_is_left(objslam, tmp_path):
    done = objslam("calibrate", str(tmp_path / "a"), str(tmp_path / "b"), "-o", str(tmp_path / "robot.yaml"))
    assert done.code == 1
    done.says_somewhere("a is left out", "b is left out", "none of the 2 logs can be used")
    assert not (tmp_path / "robot.yaml").exists()


def test_calibrate_replaces_a_file_only_if_asked(objslam, tmp_path, late_camera):
    file = tmp_path / "robot.yaml"
    file.write_text("mine")
    done = objslam("calibrate", str(late_camera), "-o", str(file))
    assert done.code == 1
    done.says("robot.yaml", "there is a file already", "--overwrite")
    assert file.read_text() == "mine"
    done = objslam("calibrate", str(late_camera), "-o", str(file), "--overwrite", *BY_LABEL)
    assert done.code == 0, done.err
    assert load_calibration(file).names
    objslam("calibrate", str(late_camera), "-o", str(tmp_path / "no" / "robot.yaml")).says("folder does not exist")


def test_calibrate_that_may_not_estimate_says_so(objslam, tmp_path, late_camera):
    done = objslam("calibrate", str(late_camera), "-o", str(tmp_path / "robot.yaml"), "--set", "calibration.use=false")
    assert done.code == 2
    done.says("nothing to calibrate", "calibration.use=false")


def test_a_wrong_calibration_file_fails_before_the_log_is_read(objslam, tmp_path):
    (tmp_path / "robot.yaml").write_text("parameters: {}")
    for more in (("--mode", "joint"), ("--mode", "fixed"), ("--set", "calibration.use=false")):
        done = objslam("run", str(tmp_path / "no_log"), "--calibration", str(tmp_path / "robot.yaml"), *more)
        assert done.code == 2
        done.says("robot.yaml", "no parameters")


def test_a_calibration_of_before_is_no_news(objslam, tmp_path, late_camera):
    """A log calibrated again from its own file tightens it like a second log. Combining keeps the prior of the file once."""
    first, twice = tmp_path / "first.yaml", tmp_path / "twice.yaml"
    options = (
        *BY_LABEL,
        "--set",
        "calibration.centre=0",
    )  # An unknown image centre leaves hardly any error that the log tells.
    assert objslam("calibrate", str(late_camera), "-o", str(first), *options).code == 0
    one = load_calibration(first)
    known = Calibration(
        (*one.names, "rear.yaw"), np.append(one.values, 0.3), block_diag(one.covariance, 1e-4), np.append(one.prior, 1)
    )
    first.write_text(dump_calibration(known))
    done = objslam("calibrate", str(late_camera), "-o", str(twice), *options, "--set", f"calibration.file={first}")
    assert done.code == 0, done.err
    done.says_somewhere("rear.yaw")
    again = load_calibration(twice)
    assert again.names == known.names
    assert again.values[-1] == pytest.approx(0.3)
    assert again.sigma[-1] == pytest.approx(0.01)
    np.testing.assert_allclose(again.expected, known.values, rtol=1e-6, atol=1e-12)
    np.testing.assert_allclose(again.before, known.covariance, rtol=1e-6, atol=1e-15)
    assert (again.sigma < 1.001 * known.sigma).all()
    # Two equal halves of information: each of the parameters that the log tells has a sigma smaller by the root of 2.
    told = one.sigma < 0.2 * one.prior
    assert told.any()
    np.testing.assert_allclose((again.sigma / known.sigma)[:-1][told], np.sqrt(0.5), atol=0.1)


def test_calibrate_in_joint_mode_needs_no_odometry(objslam, tmp_path):
    log = simulate(preset("demo", objects=8, classes=8, frames=120, odometry=None), 1)
    write_log_folder(add_shared_errors(log, {"front.clock": 0.15}), tmp_path / "log")
    file = tmp_path / "robot.yaml"
    done = objslam("calibrate", str(tmp_path / "log"), "-o", str(file))
    assert done.code == 0, done.err
    found = load_calibration(file)
    clock = found.names.index("front.clock")
    assert abs(found.values[clock] - 0.15) < 4 * found.sigma[clock]


def test_calibrate_at_known_poses_and_run_with_what_it_found(objslam, tmp_path):
    log = simulate(preset("demo", objects=8, classes=8, frames=120, odometry=None), 1)
    write_log_folder(add_shared_errors(log, {"front.clock": 0.15}), tmp_path / "log")
    file, fast = tmp_path / "robot.yaml", BY_LABEL
    done = objslam("calibrate", str(tmp_path / "log"), "--mode", "fixed", "-o", str(file), *fast)
    assert done.code == 0, done.err
    found = load_calibration(file)
    assert abs(found.values[0] - 0.15) < 4 * found.sigma[0]
    assert found.names[0] == "front.clock"
    settings = (*fast, "--set", "calibration.use=true", "--calibration", str(file))
    done = objslam("run", str(tmp_path / "log"), "-o", str(tmp_path / "out"), *settings)
    assert done.code == 0, done.err
    assert "errors that all measurements share" in done.out
    parameters = json.loads((tmp_path / "out" / "summary.json").read_text())["calibration"]["parameters"]
    assert parameters["front.clock"]["prior_sigma"] == pytest.approx(found.sigma[0], rel=1e-6)


def test_calibrate_at_fixed_poses_without_localisation_says_what_it_needs(objslam, tmp_path, late_camera):
    done = objslam("calibrate", str(late_camera), "--mode", "fixed", "-o", str(tmp_path / "robot.yaml"))
    assert done.code == 2
    done.says("nothing to calibrate", "localisation")


def test_doctor_names_what_is_wrong_and_leaves_the_log_alone(objslam, tmp_path):
    """A camera.yaml with the inverse of base_T_camera, as an optical frame's pose is often written."""
    log = simulate(preset("demo", objects=10, classes=10, frames=200), 3)
    write_log_folder(log, tmp_path / "right")
    write_log_folder(MISTAKES["base_T_camera inverted"](log), tmp_path / "wrong")
    before = {file: file.read_bytes() for file in tmp_path.rglob("*") if file.is_file()}
    right, wrong = (objslam("doctor", tmp_path / name) for name in ("right", "wrong"))
    assert (right.code, wrong.code) == (0, 1)
    assert re.fullmatch(
        r"\d+ % of the boxes fit the log as it is; no correction fits( clearly)? better \(\d+ tried\)\n"
        "nothing wrong was found\n",
        right.out,
    )
    assert "base_T_camera is probably camera_T_base" in wrong.out
    assert re.search(r"with base_T_camera inverted, \d+ % of the boxes fit instead of \d+ %", wrong.out)
    assert "the log as it is" in wrong.out
    assert {file: file.read_bytes() for file in tmp_path.rglob("*") if file.is_file()} == before


def test_a_path_that_cannot_be_used_and_malformed_frames_are_no_good_input(objslam, variant, tmp_path):
    """The map is in another frame then, or lacks things, so neither a run nor doctor may call all good."""
    rewrite_frames(variant, lambda i, frame: {**frame, "scores": 1} if i % 3 == 0 else frame)
    (variant / "localization.txt").write_text("none\n")
    called, doctor = objslam("run", variant, "-o", tmp_path / "out", *LEAN), objslam("doctor", variant)
    found = summary(tmp_path / "out")["assessment"]
    assert found["level"] == "check"
    lost = ["The map is made without localization.txt", "of the frames of boxes were dropped, because they are malformed"]
    assert all(any(text in reason for reason in found["reasons"]) for text in lost)
    assert all(text in doctor.out for text in lost)
    assert "nothing wrong" not in doctor.out
    assert called.code == 0


def test_a_run_on_wrong_input_says_so(objslam, tmp_path):
    log = simulate(preset("demo", objects=10, classes=10, frames=200), 3)
    write_log_folder(MISTAKES["yaw of poses negated"](log), tmp_path / "log")
    called = objslam("run", tmp_path / "log", "-o", tmp_path / "out", *LEAN)
    assert called.code == 0
    called.says_somewhere("yaw of the poses is clockwise", "no object is called ok")
    told = summary(tmp_path / "out")
    assert told["wrong_input"][0]["name"] == "yaw negated"
    assert told["counts"]["objects"] == told["counts"]["unresolved"]
