"""What a session does when something in it breaks: nobody waits for ever, and the map so far is not lost."""

import errno
import importlib
import json
import signal
import threading
from types import SimpleNamespace

import numpy as np
import pytest
from quick import HELD, NOTHING_DRAWN, options
from waiting import LIMIT, wait_for

from objslam.config import Odometry, load_settings
from objslam.errors import LogError, SolveError
from objslam.io.results.read import load_map
from objslam.live.adapters.replay import ReplayAdapter
from objslam.live.mapper.mapper import Mapper
from objslam.live.session import session as sessions
from objslam.live.session.session import Session
from objslam.live.session.snapshots import Describer
from objslam.live.worker import Worker
from objslam.simulation import preset, simulate
from objslam.sources.journal import journal as journals
from objslam.sources.log_folder import write_log_folder

SETTINGS = load_settings(None, ("mode=joint", "rays.pixel_sigma=2", *HELD))
QUIET = options(*HELD, *NOTHING_DRAWN, "rays.pixel_sigma=2")
live_command = importlib.import_module("objslam.cli.live_command.command")


@pytest.fixture(scope="module")
def log():
    return simulate(preset("demo", frames=150, classes=12, false=0.0, localization=None, odometry=Odometry()), 0)


@pytest.fixture(scope="module")
def folder(log, tmp_path_factory):
    folder = tmp_path_factory.mktemp("failures") / "log"
    write_log_folder(log, folder)
    return folder


@pytest.fixture
def breaks(monkeypatch):
    """Makes a method fail from its nth call on."""

    def at(owner, name, number, error):
        whole, calls = getattr(owner, name), [0]

        def broken(self, *args, **more):
            calls[0] += 1
            if calls[0] >= number:
                raise error
            return whole(self, *args, **more)

        monkeypatch.setattr(owner, name, broken)

    return at


def ends(work):
    """Whether work comes to an end."""
    thread = threading.Thread(target=work, daemon=True)
    thread.start()
    thread.join(LIMIT)
    return not thread.is_alive()


def replayed(log, session):
    adapter = ReplayAdapter(session, log, None, session.wait)
    return ends(lambda: adapter.run(threading.Event()))


def test_a_session_that_breaks_keeps_nobody_waiting_and_keeps_its_map(log, breaks):
    error = RuntimeError("it broke\nin two lines")
    breaks(Mapper, "take", 120, error)
    session = Session(SETTINGS, patient=True).start()
    assert replayed(log, session)
    assert session.failure is error
    assert not session.wait()
    assert not session.push_odometry(1e6, np.eye(4))
    last = session.snapshot()
    assert len(last.map.resolved()) >= 8
    result = session.stop()
    assert len(result.map.resolved()) >= 8
    (warning,) = session.counters.ledger.warnings
    assert "ended early" in warning
    assert "it broke in two lines" in warning
    assert result.summary["warnings"] == session.counters.ledger.lines()


def test_what_waited_when_a_session_broke_is_counted(log, monkeypatch):
    begun, go = threading.Event(), threading.Event()

    def feed(self, message):
        begun.set()
        assert go.wait(LIMIT)
        raise RuntimeError("it broke")

    monkeypatch.setattr(Mapper, "feed", feed)
    session = Session(SETTINGS).start()
    assert session.push_camera(log.cameras[0].camera)
    assert begun.wait(LIMIT)
    for i in range(5):
        assert session.push_odometry(float(i), np.eye(4))
    go.set()
    assert ends(session.wait)
    session.abort()
    assert session.counters.dropped() == {"messages that waited when the session ended early": 5}


@pytest.mark.parametrize("number", [1, 2])
def test_a_snapshot_that_fails_keeps_nobody_waiting_and_the_map(log, breaks, number):
    """The first is asked for, the second is made at the end."""
    session = Session(SETTINGS, patient=True).start()
    assert replayed(log, session)
    breaks(Describer, "map", number, ValueError("no words"))
    assert ends(session.snapshot)
    assert ends(session.wait)
    assert (session.failure is not None) == (number == 1)
    assert len(session.stop().map.resolved()) >= 8
    assert str(session.failure) == "no words"


def test_nobody_waits_for_a_session_that_was_not_started(log):
    session = Session(SETTINGS)
    assert session.wait()
    assert session.push_camera(log.cameras[0].camera)
    assert not session.wait()


def test_the_first_failure_is_told_where_no_result_can_be_made(log, breaks, monkeypatch):
    breaks(Mapper, "take", 50, RuntimeError("the cause"))

    def no_finish(*what):
        raise KeyError("what came of it")

    monkeypatch.setattr(sessions, "finish", no_finish)
    session = Session(SETTINGS, patient=True).start()
    assert replayed(log, session)
    with pytest.raises(RuntimeError, match="the cause"):
        session.stop()


def test_a_session_that_breaks_while_it_resumes(log, breaks, tmp_path):
    first = Session(SETTINGS, tmp_path / "journal.objslam", patient=True).start()
    assert replayed(log, first)
    first.abort()
    breaks(Mapper, "take", 100, RuntimeError("it broke"))
    session = Session(SETTINGS, tmp_path / "journal.objslam", resume=True).start()
    assert str(session.failure) == "it broke"
    assert not session.wait()
    assert len(session.snapshot().map.resolved()) >= 5
    assert len(session.stop().map.resolved()) >= 5


def test_a_journal_that_cannot_be_closed_costs_no_map(log, tmp_path, monkeypatch):
    session = Session(SETTINGS, tmp_path / "journal.objslam", patient=True).start()
    assert replayed(log, session)

    def fsync(stream):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(journals.os, "fsync", fsync)
    assert len(session.stop().map.resolved()) >= 8
    (line,) = session.counters.ledger.warnings
    assert line == f"{tmp_path / 'journal.objslam'}: cannot write the end of the journal: No space left on device"


@pytest.fixture
def command(objslam):
    """`objslam live` in this process: exit code, and the lines on stderr."""

    def call(source, out, *more):
        ended = objslam("live", source, "-o", out, *QUIET, "--quiet", *more)
        return ended.code, ended.err.strip().splitlines()

    return call


@pytest.mark.parametrize(("speed", "frames", "least"), [("0", 120, 8), ("20", 5, 0)])
def test_the_command_writes_what_was_mapped_and_ends_with_one_line(folder, breaks, command, tmp_path, speed, frames, least):
    breaks(Mapper, "take", frames, RuntimeError("it broke\nin two lines"))
    out = tmp_path / "out"
    code, lines = command(folder, out, "--speed", speed)
    assert code == 1
    (line,) = [line for line in lines if not line.startswith("warning: ")]
    said = "the session ended early: internal error, RuntimeError: it broke in two lines"
    hint = f"the map covers the messages until then; `objslam run {out}` maps all received messages"
    assert line == f"objslam: {said} ({hint})"
    assert len(load_map(out).resolved()) >= least
    assert "ended early" in json.loads((out / "summary.json").read_text())["warnings"][-1]


@pytest.mark.parametrize(
    ("error", "cause"),
    [
        (SolveError("no\nway", hint="go\nround"), "no way (go round)"),
        (OSError(errno.ENOMEM, "Cannot allocate memory"), "out of memory"),
        (MemoryError(), "out of memory"),
    ],
)
def test_the_command_tells_a_cause_that_a_user_can_mend(folder, breaks, command, tmp_path, error, cause):
    breaks(Mapper, "take", 120, error)
    code, lines = command(folder, tmp_path / "out", "--speed", "0", "--no-journal")
    assert code == 1
    assert lines[-1] == f"objslam: the session ended early: {cause} (the map covers the messages until then)"


@pytest.mark.parametrize("error", [OSError(errno.ENOMEM, "Cannot allocate memory"), RuntimeError("can't start new thread")])
def test_work_beside_a_session_fails_alone_where_no_thread_starts(monkeypatch, error, own_processes):
    def no_thread(thread):
        raise error

    monkeypatch.setattr("objslam.live.worker.start_thread", no_thread)
    worker = Worker()
    for _ in range(2):
        worker.ask(None)
        assert worker.busy
        assert worker.done
        assert worker.result() is None
        assert not worker.busy
        assert not worker.done
    worker.ask(None)
    worker.close()
    assert not worker.busy


def test_the_command_leaves_the_last_snapshot_where_no_result_can_be_made(folder, breaks, command, tmp_path, monkeypatch):
    def no_finish(*what):
        raise KeyError("what came of it")

    breaks(Mapper, "take", 120, RuntimeError("it broke"))
    monkeypatch.setattr(sessions, "finish", no_finish)
    code, lines = command(folder, tmp_path / "out", "--speed", "0")
    assert code == 1
    assert "RuntimeError: it broke" in lines[-1]
    assert len(load_map(tmp_path / "out").resolved()) >= 5


@pytest.mark.parametrize("when", [1, 2])
def test_a_view_that_breaks_costs_no_map(folder, command, tmp_path, monkeypatch, when):
    """The first snapshot after the drive is shown while the source goes on, the last one at the end."""
    shown, make = [], live_command.Feed
    driven, seen = threading.Event(), threading.Event()

    def view(snapshot):
        if driven.is_set():
            shown.append(snapshot)
            seen.set()
            if len(shown) >= when:
                raise RuntimeError("the window\nwent")

    def feed_with_view(source):
        def run(stop):
            source.run(stop)
            driven.set()
            seen.wait(LIMIT)

        return make(SimpleNamespace(ledger=source.ledger, run=run), views=(view,))

    monkeypatch.setattr(live_command, "Feed", feed_with_view)
    code, lines = command(folder, tmp_path / "out", "--speed", "0", "--interval", "0.1")
    assert code == 1
    assert "internal error, RuntimeError: the window went (" in lines[-1]
    assert len(shown) >= when
    assert len(load_map(tmp_path / "out").resolved()) >= 8
    assert (tmp_path / "out" / "summary.json").exists()


def test_what_is_said_of_a_source_that_breaks_is_one_line(folder, command, tmp_path, monkeypatch):
    run = ReplayAdapter.run

    def run_then_break(adapter, stop):
        run(adapter, stop)
        raise LogError("the plug\nwas pulled")

    monkeypatch.setattr(ReplayAdapter, "run", run_then_break)
    code, lines = command(folder, tmp_path / "out", "--speed", "0")
    assert code == 0
    assert "warning: the source ended: the plug was pulled" in lines


class Asleep:
    """A request that is never answered."""

    def __reduce__(self):
        return signal.pause, ()


def test_a_worker_ends_with_its_session_in_the_middle_of_a_request(own_processes):
    """A killed session cannot end its worker, but its end of the pipe closes."""
    worker = Worker()
    worker.ask(Asleep())
    try:
        wait_for(lambda: not worker._waiting)
        worker._process.stdin.close()
        assert worker._process.wait(LIMIT) == 0
        assert worker.result() is None
    finally:
        worker.close()
