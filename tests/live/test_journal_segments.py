"""Long journals: their segments, what damage costs, old formats, and a disk that fills up."""

import itertools
import struct
import zlib

import numpy as np
import pytest
from faults import in_child, killed_at
from waiting import wait_for

from objslam.core.diagnostics import Ledger
from objslam.core.geometry import make_pose
from objslam.sources.journal import journal as journals
from objslam.sources.journal.journal import Journal
from objslam.sources.journal.reader import messages
from objslam.sources.journal.record_format import read_header
from objslam.sources.journal.records import PoseMessage, encode
from objslam.sources.journal.segments import is_journal


@pytest.fixture(autouse=True)
def often(monkeypatch):
    """The thread of a journal wakes often, so that no test waits for it."""
    monkeypatch.setattr(journals, "_SYNC_EVERY", 0.01)


def pose(stamp, x):
    return PoseMessage("odometry", stamp, make_pose(np.eye(3), np.array([x, 0.0, 0.0])))


def write(file, found, resume=False):
    journal = Journal(file, resume)
    for message in found:
        journal.write(message)
    journal.close()


def old_journal(file, found):
    """A journal of format 1, byte for byte as it was written before there were segments."""
    contents = [encode(m) for m in found]
    rows = [struct.pack("<II", len(c), zlib.crc32(c)) + c for c in contents]
    file.write_bytes(b"OBJSLAM1" + b"".join(rows))


def test_an_old_journal_is_read_and_continued(tmp_path):
    file = tmp_path / "journal.objslam"
    old_journal(file, [pose(float(i), i) for i in range(5)])
    assert is_journal(file)
    journal = Journal(file, resume=True, segment=100)
    wait_for(lambda: file.read_bytes()[:8] == b"OBJSLAM2")  # It became the first segment of a journal of format 2.
    journal.write(pose(5.0, 5))
    journal.close()
    assert [m.stamp for m in messages(file, Ledger())] == [0, 1, 2, 3, 4, 5]
    data = bytearray(b"OBJSLAM1" + b"x" * 40)
    file.write_bytes(bytes(data))
    ledger = Ledger()
    assert list(messages(file, ledger)) == []
    assert "torn record" in ledger.lines()[0]


def segmented(file, count=40, each=10):
    """A journal of `count` messages, in segments of `each` messages."""
    for first in range(0, count, each):
        journal = Journal(file, resume=first > 0, segment=100)
        for i in range(first, first + each):
            journal.write(pose(float(i), i))
        number = first // each + 2
        wait_for(
            lambda number=number: list(file.parent.glob(f"*.{number - 1:06d}.objslam.zst")) and header_of(file) == number
        )
        journal.close()


def header_of(file):
    with file.open("rb") as stream:
        return read_header(stream).number


def test_segments_are_one_journal_under_any_name(tmp_path):
    file = tmp_path / "journal.objslam"
    segmented(file)
    assert len(list(tmp_path.glob("journal-*.zst"))) == 4
    assert len(list(tmp_path.iterdir())) == 5
    assert [m.stamp for m in messages(tmp_path, Ledger())] == list(range(40))
    write(file, [pose(100.0, 1.0)])  # A new session sets the journal aside.
    assert [m.stamp for m in messages(tmp_path / "journal.1.objslam", Ledger())] == list(range(40))
    assert [m.stamp for m in messages(file, Ledger())] == [100.0]


def test_a_missing_or_damaged_segment_costs_only_itself(tmp_path):
    file = tmp_path / "journal.objslam"
    segmented(file)
    first, second, *_ = sorted(tmp_path.glob("journal-*.zst"))
    first.unlink()
    second.write_bytes(b"rubbish")
    ledger = Ledger()
    assert [m.stamp for m in messages(file, ledger)] == list(range(20, 40))
    assert ledger.dropped == {"segment of the journal that is missing": 1, "segment of the journal that is damaged": 1}


def test_killed_while_it_seals_a_journal_loses_nothing(tmp_path):
    for step in itertools.count():
        folder = tmp_path / str(step)
        folder.mkdir()
        file = folder / "journal.objslam"
        write(file, [pose(float(i), i) for i in range(20)])

        def work(file=file):
            journal = Journal(file, resume=True, segment=10**9)
            journal._segment = 1
            journal._seal()
            journal.close()

        code = in_child(killed_at(step, work))
        assert [m.stamp for m in messages(file, Ledger())] == list(range(20)), step
        journal = Journal(file, resume=True, segment=10**9)
        journal.write(pose(20.0, 1))
        journal.close()
        assert [m.stamp for m in messages(file, Ledger())] == list(range(21)), step
        sealed = header_of(file) > 1
        assert len(list(folder.iterdir())) == 1 + sealed + (not sealed and len(list(folder.glob("journal-*"))))
        if code == 0:
            break
        assert code == -9
    assert step > 8


def test_a_disk_that_fills_ends_the_journal_in_time_and_not_the_session(tmp_path, monkeypatch):
    free, said = [10**9], []
    usage = type("usage", (), {"total": 10**10, "free": property(lambda self: free[0])})()
    monkeypatch.setattr(journals.shutil, "disk_usage", lambda path: usage)
    journal = Journal(tmp_path / "journal.objslam", min_free=10**8, warn=said.append)
    journal.write(pose(0.0, 1.0))
    free[0] = 15 * 10**7
    wait_for(lambda: said)
    assert "150.0 MB of the disk are free, the journal stops at 100.0 MB" in said[0]
    journal.write(pose(1.0, 1.0))
    free[0] = 10**7
    wait_for(lambda: journal.stopped)
    journal.write(pose(2.0, 1.0))
    journal.close()
    ledger = Ledger()
    assert [m.stamp for m in messages(tmp_path, ledger)] == [0.0, 1.0]
    (warning,) = ledger.warnings
    assert "the journal stopped here: only 10.0 MB of the disk are free" in warning
    write(tmp_path / "journal.objslam", [pose(3.0, 1.0)], resume=True)
    assert [m.stamp for m in messages(tmp_path, Ledger())] == [0.0, 1.0, 3.0]


def test_a_journal_that_is_deleted_is_told(tmp_path):
    said = []
    journal = Journal(tmp_path / "journal.objslam", warn=said.append)
    (tmp_path / "journal.objslam").unlink()
    wait_for(lambda: journal.stopped)
    journal.close()
    assert said == [f"{journal.file}: the journal stops, and the session goes on without it: the file was deleted"]
