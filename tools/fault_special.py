"""Faults that are not at one call of the disk: small disks, limits, folders of other users, signals, closed pipes.

Each function takes a folder for its files, and returns one line for each thing that is wrong.
"""

from __future__ import annotations

import os
import resource
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from fault_cases import Case, make_cases, said_well
from small_log import small_log

from objslam.io.results.files import SUMMARY
from objslam.io.results.read import load_map
from objslam.sources.log_folder import write_log_folder

_NOBODY = 65534
_QUIET = ("--set", "output.recording=false", "--set", "output.picture=false")
_COMMANDS = ("run, older", "live replay", "convert", "export csv", "report")


def small_disks(place: Path) -> list[str]:
    """Run every command on a disk of 2 MB that is nearly full."""
    disk, wrong = place / "disk", list[str]()
    disk.mkdir()
    if subprocess.run(["mount", "-t", "tmpfs", "-o", "size=2m", "tmpfs", disk], check=False, capture_output=True).returncode:
        return ["not tried: this user may not mount a disk"]
    try:
        for case in make_cases(place / "small", _COMMANDS):
            for left in (0, 4, 12, 40, 120):
                case.lay(disk / "work")
                _fill(disk, left)
                wrong += _judged(f"{left} kB left", case, disk / "work", case.run(disk / "work"), lambda: _empty(disk))
    finally:
        subprocess.run(["umount", disk], check=True)
    return wrong


def short_files(place: Path) -> list[str]:
    """Run with a limit on the length of each file. The run writes all its files, also those that C and Rust code writes."""
    run = make_cases(place, ("run, older",))[0]
    whole = Case(run.name, run.words[: run.words.index("--set")], run.before, run.after, seal=run.seal)
    wrong = []
    for size in (1000, 4000, 20_000, 60_000):  # What the command says goes into a file too.
        whole.lay(place / "work")
        done = whole.run(place / "work", before=lambda size=size: resource.setrlimit(resource.RLIMIT_FSIZE, (size, size)))
        if done.code != 1 or whole.judge(place / "work") != "old":
            wrong.append(f"{size} bytes: exit code {done.code}, {done.err}")
        else:
            wrong += _said(f"{size} bytes", run, done)
    return wrong


def foreign_folders(place: Path) -> list[str]:
    """Run every command in folders that it may not write, and in folders that it may not even enter."""
    wrong = []
    place.parent.chmod(0o755)
    for case in make_cases(place, _COMMANDS):
        for mode in (0o755, 0o700):
            place.chmod(0o755)
            case.lay(place / "work")
            place.chmod(mode)
            done = case.run(place / "work", before=lambda: _give_up_rights(place / "work"))
            wrong += [] if done.code == 1 else [f"{case.name}, {mode:o}: exit code {done.code}"]
            wrong += _judged(f"{mode:o}", case, place / "work", done, lambda: None)
    return wrong


def little_memory(place: Path) -> list[str]:
    """Start a run and a session that may take only some MB more than they start with."""
    wrong = []
    for case in make_cases(place, ("run, older", "live replay")):
        for more in (1, 8, 32, 64, 128):

            def limit(more: int = more) -> None:
                pages = int(Path("/proc/self/statm").read_text().split()[0])
                size = pages * resource.getpagesize() + (more << 20)
                resource.setrlimit(resource.RLIMIT_AS, (size, size))

            case.lay(place / "work")
            wrong += _judged(f"{more} MB more", case, place / "work", case.run(place / "work", before=limit), lambda: None)
    return wrong


def deleted_while_live(place: Path) -> list[str]:
    """Delete the folder of a session while the robot drives. The map must be written all the same."""
    with _session(place, "--speed", "2") as (process, out):
        _until(lambda: (out / "objects.json").exists())
        shutil.rmtree(out)
        _, err = process.communicate()
        wrong = [] if process.returncode == 0 else [f"exit code {process.returncode}: {err}"]
        return wrong + _whole(out) + ([] if "the journal stops" in err else [f"nothing said: {err}"]) + _traces(err)


def two_in_one_folder(place: Path) -> list[str]:
    """Start two runs into one folder at the same time. One may refuse, and one whole result must be left."""
    log = _log(place)
    words = [sys.executable, "-m", "objslam", "run", str(log), "-o", str(place / "out"), *_QUIET]
    pipes = {"stdout": subprocess.DEVNULL, "stderr": subprocess.PIPE, "text": True}
    both = [subprocess.Popen([*words, "--set", f"seed={seed}"], **pipes) for seed in (1, 2)]  # type: ignore[call-overload]
    said = [process.communicate()[1] for process in both]
    codes = [process.returncode for process in both]
    wrong = [] if 0 in codes and set(codes) <= {0, 1} else [f"exit codes {codes}: {said}"]
    return wrong + [line for err in said for line in _traces(err)] + _whole(place / "out")


def closed_pipes(place: Path) -> list[str]:
    """Close the pipe of stdout after the first line. The files must be whole."""
    wrong = []
    for case in make_cases(place, _COMMANDS):
        case.lay(place / "work")
        words = " ".join(f"'{word}'" for word in case.words_for(place / "work"))
        command = f"'{sys.executable}' -m objslam {words} | head -1"
        done = subprocess.run(["bash", "-c", command], capture_output=True, text=True, check=False)
        wrong += [f"{case.name}: {line}" for line in _traces(done.stderr)]
        state = case.judge(place / "work")
        wrong += [] if state == "new" else [f"{case.name}: the result is {state}"]
    return wrong


def signals(place: Path) -> list[str]:
    """Tell a session to end, in each of three ways. It must end with a whole result."""
    wrong = []
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        with _session(place, "--speed", "1") as (process, out):
            _until(lambda out=out: (out / "objects.json").exists() and '"id"' in (out / "objects.json").read_text())
            process.send_signal(number)
            _, err = process.communicate()
            lines = [] if process.returncode == 0 else [f"exit code {process.returncode}: {err}"]
            wrong += [f"{number.name}: {line}" for line in [*lines, *_whole(out), *_traces(err)]]
    return wrong


def _judged(what: str, case: Case, folder: Path, done: object, mend: Callable[[], object]) -> list[str]:
    """Return what is wrong: with the words of a command, with the files that it left, or with its next start without the
    fault."""
    wrong = _said(what, case, done)
    try:
        state = case.judge(folder)
        if done.code == 0:  # type: ignore[attr-defined]
            assert state == "new", f"exit code 0, but the result is {state}"
        mend()
        case.judge_next(folder)
    except AssertionError as error:
        wrong.append(f"{case.name}, {what}: {str(error)[:500]}")
    return wrong


def _said(what: str, case: Case, done: object) -> list[str]:
    try:
        said_well(case, done)  # type: ignore[arg-type]
    except AssertionError as error:
        return [f"{case.name}, {what}: {str(error)[:500]}"]
    return []


def _fill(disk: Path, left: int) -> None:
    """Fill a disk until `left` kB are free."""
    free = os.statvfs(disk).f_bavail * os.statvfs(disk).f_frsize
    (disk / "filler").write_bytes(bytes(max(0, free - (left << 10))))


def _empty(disk: Path) -> None:
    (disk / "filler").unlink()


def _give_up_rights(folder: Path) -> None:
    """Become a user who does not own the folder, or else make it read-only."""
    if os.getuid() == 0:
        os.setuid(_NOBODY)
        return
    for entry in (folder, *folder.rglob("*")):
        entry.chmod(0o555 if entry.is_dir() else 0o444)


def _log(place: Path) -> Path:
    if not (place / "log").exists():
        write_log_folder(small_log(frames=60), place / "log", overwrite=True)
    return place / "log"


@contextmanager
def _session(place: Path, *more: str) -> Iterator[tuple[subprocess.Popen[str], Path]]:
    """A session in a process of its own, and its folder."""
    out = place / "session"
    shutil.rmtree(out, ignore_errors=True)
    words = [sys.executable, "-m", "objslam", "live", str(_log(place)), "-o", str(out), "--interval", "0.2", *_QUIET, *more]
    with subprocess.Popen(words, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True) as process:
        yield process, out


def _until(condition: Callable[[], bool]) -> None:
    while not condition():
        time.sleep(0.02)


def _whole(out: Path) -> list[str]:
    if not (out / SUMMARY).exists():
        return ["no result"]
    hidden = [path.name for path in out.rglob(".*")]
    return ([] if len(load_map(out)) else ["an empty map"]) + [f"left: {name}" for name in hidden]


def _traces(err: str) -> list[str]:
    words = ("Traceback", "internal error", "Exception ignored")
    return [f"stderr has {word}: {err[-500:]}" for word in words if word in err]


SPECIAL = {f.__name__.replace("_", " "): f for f in (
    small_disks, short_files, foreign_folders, little_memory, deleted_while_live, two_in_one_folder, closed_pipes, signals,
)}  # fmt: skip
