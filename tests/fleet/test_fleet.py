"""The command `objslam fleet` on small logs: results by content, faults, sites, tables and the page."""

import json
import os
import shutil
import signal
import subprocess
import sys
from hashlib import sha256
from pathlib import Path

import commands
import numpy as np
import pyarrow.parquet as pq
import pytest
from fleet.fleet_logs import LAYOUT, write_logs
from processes import running
from quick import ROUGH, options
from waiting import wait_for

import objslam
from objslam.config import load_settings
from objslam.fleet.page import duration
from objslam.fleet.record import Record, parse_seen
from objslam.fleet.stores.open_store import open_store
from objslam.fleet.stores.store import StoreError

COUNT = 4
COMMAND = ("--layout", LAYOUT, *options("output.picture=false", *ROUGH))


def start(*arguments):
    """Start the command as a process of its own."""
    command = [sys.executable, "-m", "objslam", "fleet", *map(str, arguments), *COMMAND, "-j", "2"]
    return running(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def call(*arguments):
    """Run the command with one worker. Return its exit code, the JSON that it printed, and its errors."""
    done = commands.call("fleet", *arguments, *COMMAND, "-j", "1", "--json")
    return done.code, json.loads(done.out) if done.out else None, done.err


@pytest.fixture(scope="module")
def logs(tmp_path_factory):
    folder = tmp_path_factory.mktemp("logs")
    write_logs(folder, range(COUNT))
    return folder


@pytest.fixture(scope="module")
def fleet(logs, tmp_path_factory):
    """The output of a fleet, and what it said."""
    out = tmp_path_factory.mktemp("fleet") / "out"
    code, said, warned = call(logs, "-o", out, "--price", "0.05")
    assert (code, warned) == (0, "")
    return out, said


def content(out, leave=("records", "sessions.parquet", "fleet.html", "summary.json", "fleet.json")):
    """The hash of each file whose content does not depend on the time of the run."""
    found = (file for file in sorted(out.rglob("*")) if file.is_file() and not set(leave) & set(file.parts))
    return {str(file.relative_to(out)): sha256(file.read_bytes()).hexdigest() for file in found}


def records(out):
    return [Record.parse(file.read_bytes(), file.name) for file in sorted((out / "records").iterdir())]


def test_every_log_is_mapped_as_by_hand_and_each_site_has_a_map(fleet, logs):
    out, said = fleet
    assert (said["logs"], said["new"], said["failures"]) == (COUNT, COUNT, [])
    assert [(one["site"], one["sessions"], one["islands"]) for one in said["sites"]] == [("site_0", 2, 1), ("site_1", 2, 1)]
    for one in records(out):
        hand = objslam.run(objslam.read(one.source), load_settings(None, ("output.recording=false", *ROUGH)))
        np.testing.assert_array_equal(
            objslam.Result.load(out / "results" / one.key).objects.positions, hand.objects.positions
        )
    site = objslam.ObjectMap.load(out / "sites" / "site_0")
    sources = sorted(str(path) for path in logs.glob("site_0/*/*/*"))
    keys = {one.source: one.key for one in records(out)}
    (by_hand,) = objslam.merge(
        [out / "results" / keys[one] for one in sorted(sources, key=lambda s: int(s.rpartition("_")[2]))]
    )
    np.testing.assert_allclose(site.positions, by_hand.objects.positions, atol=1e-9)
    assert {o.life.sessions_seen for o in site} <= {1, 2}


def test_a_second_run_does_nothing_and_a_day_later_only_what_is_new(fleet, logs, tmp_path):
    out, _ = fleet
    shutil.copytree(out, tmp_path / "out")
    before = content(tmp_path / "out")
    code, said, _ = call(logs, "-o", tmp_path / "out", "--price", "0.05")
    assert (code, said["new"], said["logs"]) == (0, 0, COUNT)
    assert not any(one["changed"] for one in said["sites"])
    assert content(tmp_path / "out") == before
    write_logs(tmp_path / "next", range(COUNT, COUNT + 2))
    code, said, _ = call(tmp_path / "next", "-o", tmp_path / "out", "--price", "0.05")
    assert (code, said["new"], said["logs"]) == (0, 2, 2)
    assert [(one["sessions"], one["changed"]) for one in said["sites"]] == [(COUNT // 2 + 1, True)] * 2
    assert len(records(tmp_path / "out")) == len(pq.read_table(tmp_path / "out" / "sessions.parquet")) == COUNT + 2
    for site in ("site_0", "site_1"):
        in_time = sorted((one.begin, one.key) for one in records(tmp_path / "out") if f"/{site}/" in one.source)
        (once,) = objslam.merge([tmp_path / "out" / "results" / key for _, key in in_time])
        found = objslam.ObjectMap.load(tmp_path / "out" / "sites" / site)
        np.testing.assert_allclose(found.positions, once.objects.positions, atol=1e-9)


def test_other_settings_and_copies(fleet, logs, tmp_path):
    out, _ = fleet
    shutil.copytree(out, tmp_path / "out")
    one = next(logs.glob("site_0/*/*/*"))
    shutil.copytree(one, tmp_path / "logs" / "site_0" / "r" / "d" / "copy")
    shutil.copytree(one, tmp_path / "logs" / "site_0" / "r" / "d" / "other_copy")
    code, said, _ = call(tmp_path / "logs", "-o", tmp_path / "out")
    assert (code, said["copies"], said["sites"][0]["sessions"]) == (0, 1, 2)
    assert len(records(tmp_path / "out")) == COUNT
    code, said, _ = call(tmp_path / "logs", "-o", tmp_path / "out", "--set", "seed=1")
    assert (code, said["new"], len(records(tmp_path / "out"))) == (0, 2, COUNT + 1)


def test_bad_logs_are_named_and_the_rest_goes_on(logs, tmp_path):
    good = shutil.copytree(next(logs.glob("site_0/*/*/*")), tmp_path / "logs" / "s" / "r" / "d" / "good")
    (shutil.copytree(good, good.with_name("bad<b>")) / "detections.jsonl").write_text("{}\n")
    good.with_name("empty").mkdir()
    code, said, warned = call(str(good.parent / "*"), "-o", tmp_path / "out")
    assert code == 1
    assert warned == f"objslam: 2 failed, named in {tmp_path / 'out'}/failed.parquet\n"
    rows = pq.read_table(tmp_path / "out" / "failed.parquet").to_pylist()
    assert [(Path(row["source"]).name, row["kind"], row["site"]) for row in rows] == [
        ("bad<b>", "log", "s"),
        ("empty", "log", "s"),
    ]
    assert all("\n" not in row["error"] and row["error"] for row in rows)
    page = (tmp_path / "out" / "fleet.html").read_text()
    assert "bad&lt;b&gt;" in page
    assert "<b>/" not in page
    written = {file: file.stat().st_mtime_ns for file in (tmp_path / "out" / "records").iterdir()}
    code, said, _ = call(str(good.parent / "*"), "-o", tmp_path / "out")
    assert (code, len(said["failures"]), said["new"]) == (1, 2, 0)  # A bad log is not tried again,
    assert {file: file.stat().st_mtime_ns for file in (tmp_path / "out" / "records").iterdir()} == written
    code, said, _ = call(str(good.parent / "*"), "-o", tmp_path / "out", "--retry-failed")  # unless somebody asks for it.
    assert sum(file.stat().st_mtime_ns != written[file] for file in (tmp_path / "out" / "records").iterdir()) == 2


def test_results_never_go_into_a_log(logs):
    log = next(path for path in sorted(logs.rglob("*")) if (path / "detections.jsonl").is_file())
    before = sorted(path.name for path in log.iterdir())
    code, said, error = call(log, "-o", log)
    assert (code, said) == (1, None)
    assert "this is a log" in error
    assert sorted(path.name for path in log.iterdir()) == before


def test_a_store_that_throws_a_killed_worker_and_a_killed_driver(fleet, logs, tmp_path):
    out, where = tmp_path / "out", (f"flaky://{logs}", "-o", f"flaky://{tmp_path / 'out'}", "--price", "0.05")
    with start(*where) as driver:
        wait_for(lambda: list(out.glob("seen/*.done")))
        threads = Path(f"/proc/{driver.pid}/task").glob("*/children")
        workers = [int(pid) for children in threads for pid in children.read_text().split()]
        assert workers
        os.kill(workers[0], signal.SIGKILL)
        wait_for(lambda: len(list(out.glob("seen/*.done"))) >= 2)
    kept = {file: file.stat().st_mtime_ns for file in (out / "records").glob("*.json")}
    code, said, warned = call(*where)
    assert (code, said["logs"]) == (0, COUNT), warned
    assert said["new"] <= COUNT - 2
    assert all(file.stat().st_mtime_ns == stamp for file, stamp in kept.items())
    files = [name for name in content(fleet[0]) if name.startswith("results") or name.endswith("objects.json")]
    assert len(files) > 4 * COUNT
    assert all((out / name).read_bytes() == (fleet[0] / name).read_bytes() for name in files)


def test_the_tables_are_read_by_others(fleet):
    out, _ = fleet
    sessions = pq.read_table(out / "sessions.parquet").to_pylist()
    assert len(sessions) == COUNT
    assert {(row["site"], row["day"]) for row in sessions} == {
        (f"site_{k}", f"2026-11-2{d}") for k in (0, 1) for d in (0, 1)
    }
    one = sessions[0]
    assert one["seconds"] > one["cpu"] * 0.1 > 0
    assert one["cost"] == pytest.approx(one["seconds"] / 3600 * 0.05)
    assert {p["name"] for p in one["calibration"]} >= {"front.clock", "front.yaw"}
    part = next((out / "objects.parquet").glob("site=site_1/*/*.parquet"))
    table = pq.read_table(part, partitioning=None)
    geo = json.loads(table.schema.metadata[b"geo"])
    assert (geo["version"], geo["primary_column"]) == ("1.1.0", "geometry")
    column = geo["columns"]["geometry"]
    assert (column["encoding"], column["geometry_types"], column["crs"]) == ("WKB", ["Point Z"], None)
    rows = table.to_pylist()
    for row in rows:  # ISO well-known binary: order of bytes, 1001 for a point with z, three numbers.
        assert row["geometry"][:5] == bytes([1, 0xE9, 3, 0, 0])
        np.testing.assert_array_equal(np.frombuffer(row["geometry"][5:], "<f8"), [row[name] for name in "xyz"])
    site = objslam.ObjectMap.load(out / "sites" / "site_1")
    places = np.array([[row[name] for name in "xyz"] for row in rows])
    assert np.linalg.norm(places[:, None] - site.positions, axis=2).min(axis=1).max() < 0.2
    assert len(pq.read_table(out / "objects.parquet")) == sum(row["objects"] for row in sessions)
    lives = pq.read_table(out / "sites" / "site_1" / "objects.parquet").to_pylist()
    assert {row["sessions_seen"] for row in lives} <= {1, 2}


def test_the_page_needs_no_network_and_shows_the_drift(fleet):
    page = (fleet[0] / "fleet.html").read_text()
    assert "http://" not in page.replace("http://www.w3.org", "")
    assert "https://" not in page
    assert "default-src &#39;none&#39;" in page or "default-src 'none'" in page
    assert "prefers-color-scheme: dark" in page
    assert "robot_0: front.yaw, rad" in page
    linked = [part.partition('"')[0] for part in page.split('href="')[1:]]
    assert len(linked) >= COUNT
    assert all((fleet[0] / one).is_file() for one in linked)


def test_what_is_damaged_is_said(tmp_path):
    store = open_store(str(tmp_path))
    with pytest.raises(StoreError, match="a record: not the record"):
        Record.parse(b"{}", "a record")
    assert parse_seen(["a.b.done", "a.c.failed", "junk", "d.e.failed"]) == {"a": ("b", True), "d": ("e", False)}
    store.write("a/b", b"1")
    assert (store.names("a"), store.names("c"), store.read_many(["a/b", "a/c"])) == (["b"], [], {"a/b": b"1"})
    code, _, warned = call(tmp_path / "nothing", "-o", tmp_path / "out")
    assert (code, warned) == (1, f"objslam: {tmp_path / 'nothing'}: nothing is there\n")
    code, _, warned = call(tmp_path, "-o", "s4://bucket/out")
    assert code == 1
    assert warned.startswith("objslam: s4://bucket/out: no file system for this URL")
    assert warned.count("\n") == 1


@pytest.mark.parametrize(("hours", "told"), [(15 / 3600, "15 s"), (0.07, "4.2 min"), (31.5, "31.50 h")])
def test_a_time_has_the_unit_that_suits_it(hours, told):
    assert duration(hours) == told
