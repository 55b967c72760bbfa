"""What a session accepts is what its journal keeps: no more, no less, whoever pushes and whatever is full."""

import threading

import numpy as np
from quick import HELD
from waiting import LIMIT

from objslam.config import load_settings
from objslam.core.diagnostics import Ledger
from objslam.live.mapper.mapper import Mapper
from objslam.live.session import session as sessions
from objslam.live.session.session import Session
from objslam.simulation import make_camera
from objslam.sources.journal import journal as journals
from objslam.sources.journal.reader import messages
from objslam.sources.journal.records import MountMessage

SETTINGS = load_settings(None, ("mode=joint", *HELD))


def journalled(file):
    return [m for m in messages(file, Ledger()) if hasattr(m, "path")]


def test_what_the_queue_refuses_is_not_journalled(tmp_path, monkeypatch):
    monkeypatch.setattr(sessions, "_MOST_POSES", 3)
    session = Session(SETTINGS, tmp_path / "journal.objslam")
    said = [session.push_odometry(float(i), np.eye(4)) for i in range(5)]
    assert said == [True, True, True, False, False]
    session.abort()
    assert not session.push_odometry(9.0, np.eye(4))
    assert session.counters.dropped() == {
        "poses refused because the queue was full": 2,
        "messages after the end of the session": 1,
    }
    assert [m.stamp for m in journalled(tmp_path / "journal.objslam")] == [0.0, 1.0, 2.0]
    again = Session(SETTINGS, tmp_path / "journal.objslam", resume=True).start()
    assert again.newest == 2.0
    assert again.counters.accepted() == {"odometry": 3}
    again.abort()


def test_what_comes_after_a_session_broke_is_not_journalled(tmp_path, monkeypatch):
    def feed(*what):
        raise RuntimeError("it broke")

    monkeypatch.setattr(Mapper, "feed", feed)
    session = Session(SETTINGS, tmp_path / "journal.objslam").start()
    assert session.push_camera(make_camera("front"))
    assert not session.wait(LIMIT)
    assert not session.push_odometry(0.0, np.eye(4))
    session.abort()
    assert not journalled(tmp_path / "journal.objslam")


def test_what_is_accepted_is_what_is_journalled_whoever_pushes(tmp_path, monkeypatch):
    """From several threads, into a queue that is mostly full, while the session is stopped."""
    monkeypatch.setattr(sessions, "_MOST_POSES", 2)
    session = Session(SETTINGS, tmp_path / "journal.objslam").start()
    assert session.push_camera(make_camera("front"))
    accepted, enough, stopped = [], threading.Event(), threading.Event()

    def push(number):
        stamp = float(number)
        while not stopped.is_set():
            stamp += 4
            if session.push_mount(stamp, "front", np.eye(4)):
                accepted.append(stamp)
            if len(accepted) > 200:
                enough.set()

    threads = [threading.Thread(target=push, args=(number,), daemon=True) for number in range(4)]
    for thread in threads:
        thread.start()
    assert enough.wait(LIMIT)
    session.abort()
    stopped.set()
    for thread in threads:
        thread.join()
    kept = [m.stamp for m in messages(tmp_path / "journal.objslam", Ledger()) if isinstance(m, MountMessage)]
    assert sorted(accepted) == sorted(kept)


def test_a_note_finds_a_place_where_poses_do_not(tmp_path, monkeypatch):
    """Without it, what is accepted later would be on a clock that the journal does not know."""
    monkeypatch.setattr(sessions, "_MOST_POSES", 2)
    session = Session(SETTINGS, tmp_path / "journal.objslam")
    for stamp in (100.0, 100.1, 1.0, 1.1, 1.2, 1.3, 1.4):  # the clock is set back
        session.push_odometry(stamp, np.eye(4))
    assert session.counters.accepted() == {"odometry": 2, "clock set back": 1, "notes": 1}
    session.abort()
    again = Session(SETTINGS, tmp_path / "journal.objslam", resume=True).start()
    assert again.push_odometry(1.5, np.eye(4))
    assert 100.1 < again.newest < 100.3
    again.abort()


def test_a_record_that_could_not_be_taken_back_ends_the_journal(tmp_path, monkeypatch):
    """Half a record is at the end: whatever came after it could not be read."""
    session = Session(SETTINGS, tmp_path / "journal.objslam")
    assert session.push_odometry(0.0, np.eye(4))
    write, cut = journals.os.write, journals.os.ftruncate

    def half(stream, data):
        if len(data) < 20:
            raise OSError(28, "No space left on device")
        return write(stream, data[:-10])

    def no_cut(stream, length):
        raise OSError(5, "Input/output error")

    monkeypatch.setattr(journals.os, "write", half)
    monkeypatch.setattr(journals.os, "ftruncate", no_cut)
    assert session.push_odometry(1.0, np.eye(4))
    monkeypatch.setattr(journals.os, "write", write)
    monkeypatch.setattr(journals.os, "ftruncate", cut)
    assert session.push_odometry(2.0, np.eye(4))
    session.abort()
    (warning,) = session.counters.ledger.warnings
    assert "the journal stops, and the session goes on without it: No space left on device" in warning
    assert [m.stamp for m in journalled(tmp_path / "journal.objslam")] == [0.0]


def test_a_message_too_long_to_be_read_back_is_refused(tmp_path, monkeypatch):
    monkeypatch.setattr(journals, "LONGEST", 1000)
    session = Session(SETTINGS, tmp_path / "journal.objslam")
    assert session.push_camera(make_camera("front"))
    assert not session.push_detections(1.0, "front", [[1, 1, 9, 9]], ["cup" * 1000], [1.0])
    assert session.push_odometry(0.0, np.eye(4))
    session.abort()
    assert len(journalled(tmp_path / "journal.objslam")) == 1
