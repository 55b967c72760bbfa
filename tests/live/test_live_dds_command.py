"""objslam live dds, as a user runs it: a robot in one process, the session in another, Ctrl-C at the end."""

import json
import os
import signal
import subprocess
import sys

import pytest
from domains import own_domain
from processes import running
from robot import Drive, sent, start
from typer.testing import CliRunner
from waiting import LIMIT, wait_for

pytest.importorskip("cyclonedds")

from objslam.cli.commands import build_app
from objslam.core.diagnostics import Ledger
from objslam.errors import ObjslamError
from objslam.sources.journal.reader import messages
from objslam.sources.journal.records import FrameMessage, PoseMessage


def heard(out):
    """How many poses of the odometry and frames are in the journal of a session."""
    kept = list(messages(out, Ledger()))
    odometry = sum(isinstance(message, PoseMessage) and message.path == "odometry" for message in kept)
    return {"odometry": odometry, "detections": sum(isinstance(message, FrameMessage) for message in kept)}


def test_a_drive_over_dds_becomes_a_result_folder(tmp_path):
    domain, out = own_domain(), tmp_path / "out"
    env = {name: value for name, value in os.environ.items() if name != "CYCLONEDDS_URI"}
    command = [sys.executable, "-m", "objslam", "live", "dds", "--domain", str(domain), "-o", str(out), "--publish"]
    command += ["--set", "output.recording=false", "--set", "output.picture=false"]
    with running(command, env=env, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as live:
        said = sent(start(Drive(domain, seconds=2.0, bad=2)))
        wait_for(lambda: heard(out) == {kind: len(stamps) for kind, stamps in said.items()})
        live.send_signal(signal.SIGINT)
        printed, err = live.communicate(timeout=LIMIT)
    assert live.returncode == 0, err
    summary = json.loads((out / "summary.json").read_text())
    assert summary["live"]["odometry"] == len(said["odometry"])
    assert summary["live"]["frames"] == len(said["detections"])
    assert summary["live"]["localization"] == 1
    assert summary["dropped"]["message that cannot be decoded"] == 2
    assert "wrote" in printed


@pytest.mark.parametrize(
    ("options", "code", "words"),
    [
        (["dds", "--domain", "999"], 2, "no DDS domain"),
        (["dds", "--interface", "no such"], 2, "not a network interface"),
        (["dds", "--topic", "wheels=/odom"], 2, "is not role=/name"),
        (["rclpy"], 1, "rclpy cannot be imported"),
    ],
)
def test_a_source_that_cannot_be_is_one_error_and_hinders_no_second_try(tmp_path, options, code, words):
    for _ in range(2):
        error = CliRunner().invoke(build_app(), ["live", *options, "-o", str(tmp_path / "out")]).exception
        assert isinstance(error, ObjslamError)
        assert error.exit_code == code
        assert words in str(error)
