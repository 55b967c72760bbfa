"""The engine of a Ray cluster that was started apart: the same results as from processes of this machine."""

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
from commands import call
from fleet.fleet_logs import LAYOUT, write_logs
from quick import ROUGH, options
from waiting import LIMIT, wait_for

from objslam.fleet.engines import ray_engine

ray = pytest.importorskip("ray", reason="pip install objslam[fleet]")
CLUSTER = ("--head", "--num-cpus=2", "--port=0", "--object-store-memory=80000000", "--include-dashboard=false")
COUNT = 2
COMMON = ("--layout", LAYOUT, "--json", *options("output.picture=false", *ROUGH))


@pytest.fixture(scope="module")
def address(tmp_path_factory):
    """The address of a cluster of this machine."""
    logs = tmp_path_factory.mktemp("ray")
    command = [Path(sys.executable).parent / "ray", "start", *CLUSTER, "--disable-usage-stats", "--block"]
    with (logs / "said").open("wb") as said:
        head = subprocess.Popen(command, stdout=said, stderr=said, env={**os.environ, "NO_COLOR": "1"})
    found = wait_for(lambda: re.search(r"--address='([^']+)'", (logs / "said").read_text()) or head.poll() is not None)
    assert found is not True, (logs / "said").read_text()
    yield found[1]
    head.terminate()
    head.wait(timeout=LIMIT)


@pytest.fixture(scope="module")
def logs(tmp_path_factory):
    folder = tmp_path_factory.mktemp("logs")
    write_logs(folder, range(COUNT), sites=1)
    return folder


def fleet(*arguments):
    """Run the command in a process of its own, which no connection to the cluster outlives."""
    command = [sys.executable, "-m", "objslam", "fleet", *map(str, arguments), *COMMON]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    return done.returncode, json.loads(done.stdout) if done.stdout else None, done.stderr


def fleet_here(*arguments):
    """Run the command in this process. It makes no connection to a cluster."""
    done = call("fleet", *arguments, *COMMON)
    return done.code, json.loads(done.out) if done.out else None, done.err


def test_a_cluster_gives_what_processes_give(address, logs, tmp_path):
    bad = logs / "site_0" / "robot_0" / "2026-11-20" / "bad"
    bad.mkdir()
    (bad / "odometry.txt").write_text("1 2 3\n")
    code, said, warned = fleet(logs, "-o", tmp_path / "ray", "--ray", address)
    assert (code, said["new"], [one["kind"] for one in said["failures"]]) == (1, COUNT, ["log"]), warned
    code, here, _ = fleet_here(logs, "-o", tmp_path / "here", "-j", "1")
    assert (code, here["new"]) == (1, COUNT)
    names = ["sites/site_0/objects.json", "failed.parquet"]
    names += [str(file.relative_to(tmp_path / "here")) for file in (tmp_path / "here" / "results").glob("*/[ortv]*")]
    names += [
        str(file.relative_to(tmp_path / "here")) for file in (tmp_path / "here" / "objects.parquet").rglob("*.parquet")
    ]
    assert len(names) >= 4 * COUNT
    assert all((tmp_path / "ray" / name).read_bytes() == (tmp_path / "here" / name).read_bytes() for name in names)


def test_a_task_that_no_node_can_take_is_said(address, logs, tmp_path):
    code, _, warned = fleet(logs, "-o", tmp_path / "out", "--ray", address, "--memory", "1e6")
    assert code == 2
    assert "no node of the cluster has 1 CPU, 1000000.0 GB of memory and 0 GPU" in warned


def test_no_cluster_is_ever_started(logs, tmp_path, monkeypatch):
    monkeypatch.setenv(*ray_engine._LEASE)  # So that what the command sets is gone after the test.
    code, _, warned = fleet_here(logs, "-o", tmp_path / "out", "--ray", "127.0.0.1:1")
    assert code == 1
    assert re.fullmatch(r"objslam: 127\.0\.0\.1:1: no Ray cluster answers: .*\(start one with ray start.*\)\n", warned), (
        warned
    )
    assert not (tmp_path / "out" / "seen").exists()
