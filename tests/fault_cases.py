"""The commands that write, each with a state of the disk before it, and what a fault may leave of that.

`Case.judge` says which state a fault left: "old" (as before), "new" (as after a whole run) or "none" (no result, and nothing
that looks like one). Anything else is an AssertionError: a half file, or a mix of two results.
"""

from __future__ import annotations

import errno
import importlib
import json
import shutil
from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import Path

from faults import Fault, Outcome, command, tree
from quick import QUICK
from small_log import small_log

from objslam.core.diagnostics import Ledger
from objslam.core.geometry import quaternion
from objslam.core.types import Log
from objslam.io.results.files import SUMMARY
from objslam.output.export.formats import FORMATS
from objslam.sources.journal.reader import messages
from objslam.sources.journal.record_format import NAME
from objslam.sources.journal.records import encode
from objslam.sources.journal.segments import is_journal
from objslam.sources.log_folder import write_log_folder

UNEQUAL = (SUMMARY, "report.html")
"""Files that hold times of day or durations, so that two equal runs differ in them."""


@dataclass(frozen=True)
class Case:
    """A command with its folder. words: its arguments, with {} for the folder. stdin: what it reads. seals: its last files.

    before: the files in the folder before; after: those after a whole run. live: whether the command keeps a journal.
    """

    name: str
    words: tuple[str, ...]
    before: dict[str, bytes]
    after: dict[str, bytes] = field(default_factory=dict)
    stdin: bytes = b""
    seal: str = SUMMARY
    live: bool = False
    steps: int = 0

    def lay(self, folder: Path) -> None:
        """Make the state before the command."""
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir(parents=True)
        for name, data in self.before.items():
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            (folder / name).write_bytes(data)

    def run(self, folder: Path, fault: Fault | None = None, before: Callable[[], object] = int) -> Outcome:
        """Run the command on the folder."""
        return command(self.words_for(folder), fault, self.stdin, before)

    def words_for(self, folder: Path) -> list[str]:
        """The arguments of the command for a folder."""
        return [word.format(folder) for word in self.words]

    def judge(self, folder: Path) -> str:
        """The state that the command left: old, new or none. AssertionError for anything else."""
        found = {name: data for name, data in tree(folder).items() if not _hidden(name)}
        if found == self.before:
            return "old"
        if self.live:
            self._judge_journal(folder, found)
        before, after, found = (
            {name: data for name, data in files.items() if not _is_journal(name)}
            for files in (self.before, self.after, found)
        )
        if found.keys() == after.keys() and all(self._is_new(name, data) for name, data in found.items()):
            return "new"
        assert found.get(self.seal) in (None, before.get(self.seal)), f"the new seal on {_differing(found, after)}"
        assert self.seal not in found or found == before, f"the old seal on {_differing(found, before)}"
        assert found.keys() <= before.keys() | after.keys(), f"files of nobody: {sorted(found.keys() - after.keys())}"
        changed = [name for name, data in found.items() if data != before.get(name)]
        wrong = [name for name in changed if not self._is_new(name, found[name])]
        assert not wrong, f"half files: {wrong}"
        if not self.live:  # A session writes its objects.json before the rest.
            kept = [name for name in found if name not in changed and after.get(name) != found[name]]
            assert not (changed and kept), f"a mix: new {changed}, old {kept}"
        return "none"

    def _is_new(self, name: str, data: bytes) -> bool:
        """Whether a file is one that a whole run wrote."""
        if data == self.after.get(name):
            return True
        if Path(name).name in UNEQUAL:
            return data != self.before.get(name) and (not name.endswith(".json") or bool(json.loads(data)))
        return self.live and (not name.endswith(".json") or bool(json.loads(data)))  # It may be of any moment.

    def judge_next(self, folder: Path, *, resume: bool = False) -> None:
        """The next start on what a fault left works, and nothing of the fault is left after it. resume: as live does."""
        whole = self.judge(folder) == "new"
        resume &= self.live and bool(journaled(folder / "out" / NAME))
        done = command([*self.words_for(folder), *["--resume"] * resume], stdin=self.stdin)
        refused = whole and done.code == 1 and "there is a log already" in done.err
        assert done.code == 0 or refused, f"the next start: {done.code} {done.err}"
        assert self.judge(folder) == "new", "the next start did not write the whole result"
        hidden = [str(p.relative_to(folder)) for p in folder.rglob(".*")]
        assert not hidden, f"left after the next start: {hidden}"

    def _judge_journal(self, folder: Path, found: dict[str, bytes]) -> None:
        """No message of the old journal is lost, and the new one can be read."""
        old = self.before.get(f"out/{NAME}")
        if old is not None:
            assert old in found.values(), "the old journal is gone"
        for name in found:
            if _is_journal(name) and len(found[name]) > 64:  # A shorter one may have been killed in its first bytes.
                list(messages(folder / name, Ledger()))


def journaled(file: Path) -> list[bytes]:
    """The messages of a journal, as they were written; none where there is no journal."""
    return [encode(message) for message in messages(file, Ledger())] if is_journal(file) else []


def _is_journal(name: str) -> bool:
    return name.startswith("out/journal")


_NEXT_EVERY = 3
"""After every how many faults the command is started again. A larger number costs less time."""
_PRELOADED = (
    "cv2",
    "encodings.unicode_escape",
    "encodings.utf_8_sig",
    "importlib.readers",
    "objslam.api.mapping",
    "objslam.live.session.session",
    "objslam.mapping.pipeline",
    "objslam.output.export.content",
    "objslam.output.report.page",
    "objslam.output.result_folder",
    "pyarrow.parquet",
    "rich.live",
    "rich.progress",
)
"""The modules that are imported before the forks, so that no child has to."""
_ERRORS = ((errno.EIO, False), (errno.ENOSPC, False), (errno.EIO, True), (errno.ENOSPC, True))
"""The errors, in turn: of one call, and of all calls from then on."""


def faults(case: Case, count: int, errors: bool) -> Iterator[Fault]:
    """So many faults, spread over the calls of a case."""
    for number in range(count):
        step = int((number + 0.5) * case.steps / count)
        yield Fault(step, *_ERRORS[number % len(_ERRORS)]) if errors else Fault(step)


def check(case: Case, folder: Path, fault: Fault, number: int) -> str:
    """Let the fault strike, and return the state that it left. AssertionError if anything is wrong."""
    case.lay(folder)
    done = case.run(folder, fault)
    if fault.error:
        said_well(case, done)
    else:
        assert done.killed or (case.live and done.code == 0), f"exit code {done.code}: {done.err[-300:]}"
    state = case.judge(folder)
    if done.code == 0:
        assert state == "new", f"exit code 0, but the result is {state}"
    kept = journaled(folder / "out" / NAME)
    if case.live and not fault.error:  # After an error, the session goes on without the journal.
        assert len(kept) >= done.accepted, f"{done.accepted} messages were accepted, the journal has {len(kept)}"
    if fault.error == errno.ENOSPC and fault.lasting:  # After other errors, the disk may also have refused to delete.
        left = [p.name for p in folder.rglob(".*")]
        assert not left or state == "none", f"left by an error: {left}"
    if number % _NEXT_EVERY == 0:
        case.judge_next(folder, resume=number % (2 * _NEXT_EVERY) == 0)
        journals = [file for file in (folder / "out").glob("journal*") if is_journal(file)]
        assert not kept or kept in [journaled(file)[: len(kept)] for file in journals], "the next start lost messages"
    return state


def said_well(case: Case, done: Outcome) -> None:
    """The command ended with 0 or 1; with 1, it said why in one line."""
    assert done.code in (0, 1), f"exit code {done.code}: {done.err[-300:]}"
    for word in ("Traceback", "internal error", "Exception ignored"):
        assert word not in done.err, done.err[-500:]
    if done.code == 1:
        lines = done.err.strip().splitlines()
        assert lines[-1].startswith("objslam: "), done.err
        assert case.live or len(lines) == 1, done.err


def _hidden(name: str) -> bool:
    return any(part.startswith(".") for part in Path(name).parts)


def _differing(one: dict[str, bytes], other: dict[str, bytes]) -> list[str]:
    return sorted(name for name in {*one, *other} if one.get(name) != other.get(name))


def lines_of(log: Log) -> bytes:
    """The log as lines for `objslam live stdin`, in the order of their stamps."""
    camera = log.cameras[0].camera
    assert log.odometry is not None
    rows: list[tuple[float, dict[str, object]]] = [
        (
            -1.0,
            {
                "type": "camera",
                "name": camera.name,
                "image_width": camera.width,
                "image_height": camera.height,
                "camera_matrix": camera.matrix.ravel().tolist(),
                "distortion_model": camera.distortion_model,
                "distortion_coefficients": camera.distortion.tolist(),
                "base_T_camera": {
                    "translation": camera.base_T_camera[:3, 3].tolist(),
                    "rotation_xyzw": quaternion(camera.base_T_camera[None])[0].tolist(),
                },
            },
        )
    ]
    for stamp, pose in zip(log.odometry.stamps.tolist(), log.odometry.poses, strict=True):
        place = {"translation": pose[:3, 3].tolist(), "rotation_xyzw": quaternion(pose[None])[0].tolist()}
        rows.append((stamp, {"type": "odometry", "stamp": stamp, **place}))
    found = log.cameras[0].detections
    assert found is not None
    for index, stamp in enumerate(found.frame_stamps.tolist()):
        mine = found.frame == index
        body = {"boxes": found.boxes[mine].tolist(), "scores": found.scores[mine].tolist()}
        names = [found.label_names[i] for i in found.label[mine].tolist()]
        rows.append((stamp + 1e-6, {"type": "detections", "camera": camera.name, "stamp": stamp, "labels": names, **body}))
    return b"".join(json.dumps(row).encode() + b"\n" for _, row in sorted(rows, key=lambda row: row[0]))


def make_cases(place: Path, names: Collection[str] = (), *, frames: int = 20) -> list[Case]:
    """The cases whose names begin with one of `names`, by default all. Their logs are written into the folder `place`."""
    for module in _PRELOADED:
        importlib.import_module(module)
    logs = place / "log", place / "other"
    made = [small_log(seed, frames=frames) for seed in (0, 1)]
    for log, folder in zip(made, logs, strict=True):
        write_log_folder(log, folder)
    run = ("run", str(logs[0]), "-o", "{}/out", *QUICK)
    live = ("live", str(logs[0]), "-o", "{}/out", "--speed", "0", "--interval", "0.1", *QUICK)
    stdin = ("live", "stdin", "-o", "{}/out", "--interval", "0.1", *QUICK)
    convert = ("convert", str(logs[0]), "{}/log")

    @cache
    def after(*words: str) -> dict[str, bytes]:
        return _whole(Case("", words, {}), place / "before").after

    def older() -> dict[str, bytes]:
        return after(run[0], str(logs[1]), *run[2:], "--mode", "fixed", "--set", "seed=7")

    def session() -> dict[str, bytes]:
        return after(live[0], str(logs[1]), *live[2:])

    def result() -> dict[str, bytes]:
        return after(*run, "--mode", "joint", "--set", "poses.use=odometry")

    def converted() -> dict[str, bytes]:
        return {f"log/{name}": data for name, data in tree(logs[1]).items()}

    summary = f"out/{SUMMARY}"
    rows: list[tuple[str, tuple[str, ...], Callable[[], dict[str, bytes]], str]] = [
        ("run, new folder", run, dict, summary),
        ("run, older result", run, older, summary),
        ("live replay, older session", live, session, summary),
        ("live stdin", stdin, dict, summary),
        ("convert", convert, dict, "log/camera.yaml"),
        ("convert --overwrite", (*convert, "--overwrite"), converted, "log/camera.yaml"),
        *((f"export {to}", ("export", "{}/out", "--to", to), result, f"out/{known.file}") for to, known in FORMATS.items()),
        ("eval", ("eval", "{}/out"), result, "out/evaluation.json"),
        ("report", ("report", "{}/out"), result, "out/report.html"),
    ]
    lines = lines_of(made[0])
    return [
        _whole(Case(name, words, before(), {}, lines * (words is stdin), seal, name.startswith("live")), place / "work")
        for name, words, before, seal in rows
        if not names or name.startswith(tuple(names))
    ]


def _whole(case: Case, work: Path) -> Case:
    """The case with what a run without a fault leaves, and how many of its calls change the disk."""
    case.lay(work)
    done = case.run(work)
    assert done.code == 0, f"{case.name}: {done.err}"
    after = tree(work)
    shutil.rmtree(work)
    assert not [name for name in after if _hidden(name)]
    return replace(case, after=after, steps=done.steps)
