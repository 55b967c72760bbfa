"""objslam live as a user runs it: replayed, killed, resumed, interrupted."""

import json
import re
import signal
import subprocess
import sys

import numpy as np
import pytest
import yaml
from processes import running
from quick import HELD, NOTHING_DRAWN, options
from small_log import small_log
from waiting import LIMIT, wait_for

from objslam.config import Odometry, load_settings
from objslam.core.calibration import Calibration
from objslam.core.diagnostics import Ledger
from objslam.core.object_map import MapObject, ObjectMap
from objslam.io.calibration_yaml import dump_calibration
from objslam.io.objects_json import dump_objects, read_objects
from objslam.io.results.read import load_map
from objslam.live.session.session import Session
from objslam.simulation import preset, simulate
from objslam.sources import read
from objslam.sources.journal.reader import messages
from objslam.sources.log_folder import write_log_folder

QUIET = options(*HELD, *NOTHING_DRAWN, "rays.pixel_sigma=2")


@pytest.fixture(scope="module")
def log(tmp_path_factory):
    folder = tmp_path_factory.mktemp("live") / "log"
    drive = preset("demo", frames=150, classes=12, false=0.0, localization=None, odometry=Odometry())
    write_log_folder(simulate(drive, 0), folder)
    return folder


@pytest.fixture(scope="module")
def short(tmp_path_factory):
    """A drive with four objects, for the tests that are about files."""
    folder = tmp_path_factory.mktemp("live") / "short"
    write_log_folder(small_log(localization=None), folder)
    return folder


def words(log, out, *more):
    return ["live", str(log), "-o", str(out), *QUIET, *more]


def command(log, out, *more):
    """The words that start a process, for what is killed, interrupted, or reads its standard input."""
    return [sys.executable, "-m", "objslam", *words(log, out, *more)]


def journal_in(out):
    """A folder with the journal of a session that heard one message; its bytes."""
    out.mkdir()
    session = Session(load_settings(None, ()), out / "journal.objslam")
    assert session.push_odometry(1.0, np.eye(4))
    session.abort()
    return (out / "journal.objslam").read_bytes()


def test_killed_resumed_and_mapped_from_the_journal(objslam, log, tmp_path):
    out, whole = tmp_path / "out", tmp_path / "whole"
    done = objslam(*words(log, whole, "--speed", "0"))
    assert done.code == 0, done.err
    file = out / "journal.objslam"
    with running(command(log, out, "--speed", "5", "--interval", "0.2"), stderr=subprocess.DEVNULL):
        wait_for(lambda: file.exists() and file.stat().st_size > 30_000 and (out / "objects.json").exists())
    accepted = sum(1 for _ in messages(out, Ledger()))
    json.loads((out / "objects.json").read_text())  # whole, whenever it was killed

    done = objslam(*words(log, out, "--speed", "0", "--resume"))
    assert done.code == 0, done.err
    assert sum(1 for _ in messages(out, Ledger())) >= accepted
    one, other = load_map(out).objects, load_map(whole).objects
    assert [o.label for o in one] == [o.label for o in other]
    assert max(abs(a.position - b.position).max() for a, b in zip(one, other, strict=True)) < 1e-6
    assert {"summary.json", "config.yaml", "trajectory.txt", "rays.parquet"} <= {f.name for f in out.iterdir()}
    kept, original = read(out, Ledger()), read(log, Ledger())
    assert len(kept.odometry) == len(original.odometry)
    assert len(kept.cameras[0].detections) == len(original.cameras[0].detections)


@pytest.mark.parametrize(("objects", "code", "line"), [(12, 0, "localised in"), (0, 3, "not localised in")])
def test_a_session_in_the_map_of_another_day(objslam, log, tmp_path, objects, code, line):
    """The same room, and an empty map."""
    known = simulate(preset("demo", frames=150, classes=12, false=0.0), 0).truth.objects[:objects]
    noise = 0.02**2 * np.eye(3)
    made = tuple(MapObject(i, o.label, o.position, noise, "ok", 9, 9, 30.0, 0.1, 0.0, 1.0) for i, o in enumerate(known))
    (tmp_path / "objects.json").write_text(dump_objects(ObjectMap(made)))
    out = tmp_path / "out"
    done = objslam(*words(log, out, "--speed", "0", "--no-journal", "--map", tmp_path / "objects.json"))
    assert done.code == code, done.err
    assert line in done.err + done.out
    told = json.loads((out / "summary.json").read_text())["localisation"]
    assert told["localised"] == (code == 0)


def test_ctrl_c_ends_with_a_whole_result(log, tmp_path):
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    objects = tmp_path / "out" / "objects.json"
    with running(command(log, tmp_path / "out", "--speed", "5", "--no-journal"), **pipes) as process:
        wait_for(lambda: objects.exists() and len(read_objects(objects)) > 0)
        process.send_signal(signal.SIGINT)
        out, err = process.communicate(timeout=LIMIT)
    assert process.returncode == 0, err
    assert "Traceback" not in err
    assert "wrote" in out
    assert (tmp_path / "out" / "summary.json").exists()
    assert not (tmp_path / "out" / "journal.objslam").exists()


def test_a_session_does_not_stand_beside_an_older_result(objslam, short, tmp_path):
    out = tmp_path / "out"
    done = objslam(*words(short, out, "--speed", "0", "--no-journal"))
    assert done.code == 0, done.err
    older = {f.name for f in out.iterdir()}
    (out / "mine.txt").touch()
    before = (out / "objects.json").stat().st_mtime_ns
    slow = command(short, out, "--speed", "0.5", "--interval", "0.1", "--no-journal")
    with running(slow, stderr=subprocess.PIPE) as process:
        wait_for(lambda: not (out / "summary.json").exists() and (out / "objects.json").stat().st_mtime_ns > before)
        process.kill()
        _, told = process.communicate(timeout=LIMIT)
    whole = {f.name for f in out.iterdir() if not f.name.startswith(".")}  # it may have been about to write another one
    assert whole == {"objects.json", "mine.txt"}
    assert all(name in told.decode() for name in older - {"objects.json"})
    done = objslam(*words(short, out, "--speed", "0", "--no-journal"))
    assert done.code == 0, done.err
    assert older <= {f.name for f in out.iterdir()}


def test_a_session_started_again_keeps_the_journal_that_was_there(objslam, short, tmp_path):
    out = tmp_path / "out"
    kept = journal_in(out)
    done = objslam(*words(short, out, "--speed", "0"))
    assert done.code == 0, done.err
    assert "--resume" in done.err
    assert (out / "journal.1.objslam").read_bytes() == kept
    assert "update p50" in done.out
    done = objslam(*words(short, out, "--speed", "0", "--resume"))
    assert done.code == 0, done.err
    assert "update p50" not in done.out  # all was in the journal: nothing was measured
    newest = (out / "journal.objslam").read_bytes()
    assert len(read(out, Ledger()).odometry) == len(read(short, Ledger()).odometry)
    done = objslam(*words(out, out, "--speed", "0"))  # a session from the journal that it is about to write
    assert done.code == 0, done.err
    assert (out / "journal.2.objslam").read_bytes() == newest
    assert len(read(out, Ledger()).odometry) == len(read(short, Ledger()).odometry)


def test_a_live_recording_is_not_where_the_result_puts_its_own(objslam, log, tmp_path):
    out = tmp_path / "out"
    failed = objslam(*words(log, out, "--view", out / "recording.rrd"))
    assert failed.code == 1
    assert "this file is the recording of the result" in failed.err
    assert len(failed.err.strip().splitlines()) == 1
    assert not out.exists()


def as_messages(log):
    """The lines for `live stdin` that say what a log folder has."""
    camera = yaml.safe_load((log / "camera.yaml").read_text())
    camera["name"] = camera.pop("camera_name")
    timed = []
    for row in np.loadtxt(log / "odometry.txt").tolist():
        timed.append({"type": "odometry", "stamp": row[0], "translation": row[1:4], "rotation_xyzw": row[4:]})
    for line in (log / "detections.jsonl").read_text().splitlines():
        timed.append({"type": "detections", "camera": camera["name"], **json.loads(line)})
    return [{"type": "camera", **camera}, *sorted(timed, key=lambda one: (one["stamp"], one["type"] == "detections"))]


@pytest.mark.parametrize("piped", [False, True])
def test_no_frame_of_recorded_lines_is_too_old(log, tmp_path, piped):
    """All lines are there at once, and the map takes longer than live.max_lag for them."""
    lines = "".join(json.dumps(message) + "\n" for message in as_messages(log))
    (tmp_path / "lines.jsonl").write_text(lines)
    start = command("stdin", tmp_path / "out", "--set", "live.max_lag=0.01", *(["--speed", "0"] if piped else []))
    with (tmp_path / "lines.jsonl").open() as file:
        given = {"input": lines} if piped else {"stdin": file}
        done = subprocess.run(start, capture_output=True, text=True, timeout=LIMIT, **given)
    assert done.returncode == 0, done.stderr
    assert "has no meaning" not in done.stderr
    told = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert told["counts"]["frames_on_path"] == 150
    assert not any("waited too long" in reason for reason in told["dropped"])


def test_nothing_to_go_on_with(objslam, log, tmp_path):
    done = objslam(*words(log, tmp_path / "out", "--resume"))
    assert done.code == 1
    assert "no journal to resume" in done.err
    assert not (tmp_path / "out").exists()


def test_where_nothing_comes_the_journal_that_was_there_stays(log, tmp_path):
    out = tmp_path / "out"
    kept = journal_in(out)
    done = subprocess.run(command("stdin", out), input="", capture_output=True, text=True, timeout=LIMIT)
    assert done.returncode == 1
    assert "no camera arrived; no odometry or localisation arrived; no detections arrived" in done.stderr
    assert "Traceback" not in done.stderr
    assert {f.name: f.read_bytes() for f in out.iterdir()} == {"journal.objslam": kept}


@pytest.mark.parametrize("more", [(), ("--resume",)])
def test_a_start_killed_before_its_first_message_costs_no_journal(log, tmp_path, more):
    out = tmp_path / "out"
    kept = journal_in(out)
    file = out / "journal.objslam"
    with running(command("stdin", out), stdin=subprocess.PIPE, stderr=subprocess.DEVNULL):
        wait_for(lambda: (out / "journal.1.objslam").exists() and file.exists() and file.stat().st_size == 24)
    done = subprocess.run(command("stdin", out, *more), input="", capture_output=True, text=True, timeout=LIMIT)
    assert done.returncode == 1
    assert "the last session was killed before its first message" in done.stderr
    told = re.search(r"continued the session in .*journal.objslam\. Messages taken before: \w+ \d+", done.stderr)
    assert bool(told) == bool(more)
    assert {f.name: f.read_bytes() for f in out.iterdir()} == {"journal.objslam": kept}


def test_a_session_starts_from_a_calibration(objslam, log, tmp_path):
    found = Calibration(("odometry.scale", "front.yaw"), np.array([0.01, 0.02]), np.diag([1e-4, 4e-6]), np.full(2, 0.03))
    file = tmp_path / "robot.yaml"
    file.write_text(dump_calibration(found))
    more = ("--speed", "0", "--no-journal", "--calibration", str(file), "--set", "calibration.use=auto")
    done = objslam(*words(log, tmp_path / "out", *more))
    assert done.code == 0, done.err
    parameters = json.loads((tmp_path / "out" / "summary.json").read_text())["calibration"]["parameters"]
    assert parameters["odometry.scale"]["prior_sigma"] == pytest.approx(0.01)
    assert parameters["front.yaw"]["prior_sigma"] == pytest.approx(0.002)
    assert parameters["front.yaw"]["value"] == pytest.approx(0.02, abs=0.01)  # of a camera that is right: the file holds it
    assert "errors that all measurements share" in done.out
    file.write_text("parameters: 3")
    failed = objslam(*words(log, tmp_path / "other", *more))
    assert failed.code == 2  # as for any setting
    assert "write it with objslam calibrate" in " ".join(failed.err.split())
    assert "Traceback" not in failed.err
    assert not (tmp_path / "other" / "objects.json").exists()


@pytest.mark.parametrize(
    ("more", "fault"), [((), "this file is not a journal"), (("--resume",), "cannot resume: this file is not a journal")]
)
def test_a_file_that_is_no_journal_stays_as_it_is(objslam, log, tmp_path, more, fault):
    out = tmp_path / "out"
    out.mkdir()
    (out / "journal.objslam").write_text("my notes about journals")
    done = objslam(*words(log, out, "--speed", "0", *more))
    assert done.code == 1
    assert fault in " ".join(done.err.split())
    assert (out / "journal.objslam").read_text() == "my notes about journals"
    assert len(list(out.iterdir())) == 1


def test_what_a_source_cannot_be_and_what_an_option_cannot_do(objslam, log, tmp_path):
    done = objslam(*words("dsd", tmp_path / "a"))
    assert done.code == 1
    assert "SOURCE is dds, rclpy, stdin" in done.err
    assert "--no-journal" in objslam(*words(log, tmp_path / "a", "--resume", "--no-journal")).err
    assert not (tmp_path / "a").exists()
    more = ("--detector", "none.onnx", "--topic", "odometry=/odom", "--domain", "0", "--speed", "2", "--robot", "1", "--raw")
    done = subprocess.run(command("stdin", tmp_path / "b", *more), input="", capture_output=True, text=True, timeout=LIMIT)
    for option in (*more[:-1:2], "--rectified"):
        assert f"warning: {option} has no meaning for stdin" in done.stderr


def test_a_closed_standard_input_is_said(tmp_path):
    command = f"{sys.executable} -m objslam live stdin -o {tmp_path / 'out'} <&-"
    done = subprocess.run(["bash", "-c", command], capture_output=True, text=True, timeout=LIMIT, check=False)
    assert done.returncode == 1
    assert "standard input is closed" in done.stderr
    assert "internal error" not in done.stderr
