"""objslam journal: what it finds in a journal, what it repairs, and what it writes."""

import io
import json

import numpy as np
from test_journal_segments import often, pose, segmented, write  # noqa: F401 - `often` is a fixture

from objslam.core.diagnostics import Ledger
from objslam.core.geometry import make_pose
from objslam.live.adapters.stdin import StdinAdapter
from objslam.simulation import make_camera, preset, simulate
from objslam.sources.journal.journal import Journal
from objslam.sources.journal.reader import messages
from objslam.sources.journal.records import CameraMessage, FrameMessage, MountMessage, NoteMessage, encode
from objslam.sources.log_folder import write_log_folder


def test_verify_and_repair(objslam, tmp_path):
    file = tmp_path / "journal.objslam"
    segmented(file, 20)
    write(file, [pose(float(i), i) for i in range(20, 25)], resume=True)
    code, out, _ = objslam("journal", "verify", tmp_path)
    assert code == 0
    assert "25 records, no damage" in out
    assert objslam("journal", "repair", tmp_path)[1] == "there is nothing to repair\n"
    data = bytearray(file.read_bytes())
    data[24 + 117 + 50] ^= 1
    file.write_bytes(bytes(data) + b"half a record")
    damaged = file.read_bytes()
    code, out, err = objslam("journal", "verify", file)
    assert code == 1
    assert "130" in out  # 117 of the record and 13 of the half one
    assert (
        err
        == f"objslam: {file}: damaged or missing: journal.objslam (`objslam journal repair` leaves out what is damaged)\n"
    )
    assert objslam("journal", "repair", file)[0] == 0
    assert (tmp_path / "journal.objslam.damaged").read_bytes() == damaged
    ledger = Ledger()
    assert [m.stamp for m in messages(file, ledger)] == [*range(21), *range(22, 25)]
    assert not ledger.lines()
    assert objslam("journal", "verify", file)[0] == 0
    next(tmp_path.glob("*.000001.*")).unlink()
    code, out, _ = objslam("journal", "verify", file)
    assert code == 1
    assert "missing" in out


def test_a_journal_in_use_is_not_repaired(objslam, tmp_path):
    journal = Journal(tmp_path / "journal.objslam")
    code, _, err = objslam("journal", "repair", tmp_path)
    journal.close()
    assert code == 1
    assert "a session writes this journal (end it first)" in err
    assert objslam("journal", "verify", tmp_path / "nothing")[0] == 1


def test_what_is_exported_can_be_pushed_again(objslam, tmp_path):
    """The messages of a second session that hears the lines are those of the first, to the last digits of a rotation."""
    box = np.array([[1.0, 2.0, 30.0, 40.0]])
    frame = FrameMessage(0.5, "front", box, ("cup",), np.ones(1), np.array([np.nan]), np.array([-1]), True)
    turned = make_pose(np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]), np.zeros(3))
    given = [
        CameraMessage(make_camera("front", yaw=0.2)),
        pose(0.0, 0.0),
        MountMessage(0.2, "front", turned),
        pose(1.0, 1.0),
    ]
    write(tmp_path / "journal.objslam", [*given, frame, NoteMessage(0.0, np.eye(4))])
    lines = tmp_path / "lines.jsonl"
    code, _, err = objslam("journal", "export", tmp_path, "-o", lines)
    assert code == 0
    assert "1 note" in err
    taken = []

    class Sink:
        def __getattr__(self, name):
            return lambda *args: taken.append((name, args))

    adapter = StdinAdapter(Sink(), io.BytesIO())
    for number, line in enumerate(lines.read_text().splitlines()):
        assert json.loads(line)
        adapter._take(line.encode(), number)
    assert not adapter.ledger.lines()
    names = ["push_camera", "push_odometry", "push_mount", "push_odometry", "push_detections"]
    assert [name for name, _ in taken] == names
    np.testing.assert_allclose(taken[2][1][2], turned, atol=1e-12)
    stamp, camera, boxes, labels, scores, depths, _, whole = taken[4][1]
    again = FrameMessage(stamp, camera, boxes, tuple(labels), scores, depths, np.array([-1]), whole)
    assert encode(again) == encode(frame)


def test_no_command_writes_into_the_folder_of_a_running_session(objslam, tmp_path):
    """Its own result, at its end, would replace the other one. After it, the folder is free."""
    log, out = tmp_path / "log", tmp_path / "out"
    write_log_folder(simulate(preset("demo", frames=150), 0), log)
    out.mkdir()
    journal = Journal(out / "journal.objslam")
    journal.write(pose(0.0, 1.0))
    before = sorted(path.name for path in out.iterdir())
    for command in (("run", log), ("merge", log), ("demo", "--boxes")):
        code, _, err = objslam(*command, "-o", out)
        assert code == 1
        assert err.startswith(f"objslam: {out / 'journal.objslam'}: a live session writes here")
        assert err.count("\n") == 1
    assert sorted(path.name for path in out.iterdir()) == before
    journal.close()
    assert objslam("run", log, "-o", out, "-q")[0] == 0
    assert (out / "objects.json").is_file()
