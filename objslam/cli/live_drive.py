"""The drive of `objslam live`: the source runs, objects.json follows, and whatever happens, a map is written."""

from __future__ import annotations

import signal
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from objslam.cli.console import console, report, say
from objslam.cli.live_status import status_line, times
from objslam.errors import ObjslamError, one_line

if TYPE_CHECKING:
    from objslam.core.snapshot import Snapshot
    from objslam.core.types import Truth
    from objslam.live.adapters import Feed
    from objslam.live.session.session import Session

_POLL = 0.1  # s; how soon the end of a source is seen


class LatestObjects:
    """objects.json of a session that has not ended yet; the first one takes the place of an older result."""

    def __init__(self, out: Path) -> None:
        self._out, self._begun = out, False

    def write(self, snapshot: Snapshot) -> None:
        """Write a snapshot's objects, once there is a keyframe."""
        from objslam.io.atomic_files import write_file
        from objslam.io.objects_json import dump_objects
        from objslam.output.result_folder import clear_result
        from objslam.results.files import OBJECTS

        if snapshot.keyframes and not self._begun:
            self._begun = True
            if removed := clear_result(self._out):
                say(f"removed from {self._out}, for it was of an older result: {', '.join(removed)}", stderr=True)
        if self._begun:
            write_file(self._out / OBJECTS, dump_objects(snapshot.map).encode())


def drive(session: Session, feed: Feed, latest: LatestObjects, interval: float) -> Exception | None:
    """Run the adapter until it ends, the session does, or Ctrl-C comes, with a status line and objects.json.

    Returns the error that broke off the watching (of a view, or a disk that refuses), for the map is to be written first.
    """
    from objslam.live.session import low_latency

    low_latency.configure()
    stop, ended, broken = threading.Event(), list[Exception](), None

    def bring() -> None:
        try:
            feed.adapter.run(stop)
        except Exception as error:  # noqa: BLE001 - told below, in the thread that can tell it
            ended.append(error)

    bringing = threading.Thread(target=bring, name="objslam adapter", daemon=True)
    told = 0
    with _ends_by_signal(stop), status_line() as show:
        bringing.start()
        due = time.monotonic() + interval
        try:
            while bringing.is_alive() and not stop.is_set() and session.failure is None:
                bringing.join(_POLL)
                for warning in feed.adapter.ledger.warnings[told:]:
                    told += 1
                    say(f"warning: {warning}", stderr=True)
                if time.monotonic() >= due:
                    due = time.monotonic() + interval
                    snapshot = session.snapshot()
                    latest.write(snapshot)
                    for view in feed.views:
                        view(snapshot)
                    show(snapshot)
        except Exception as error:  # noqa: BLE001 - raised by `finish`, once the map is written
            broken = error
        stop.set()
        bringing.join()
    if ended:
        say(f"warning: the source ended: {one_line(ended[0])}", stderr=True)
    return broken


def finish(
    session: Session, feed: Feed, out: Path, latest: LatestObjects, truth: Truth | None, broken: Exception | None
) -> None:
    """End the session, write its result, and say what came of it.

    What ended the session early or broke off the watching is raised after that, as an ObjslamError where it was the session.
    Where no result can be made, objects.json is that of the last snapshot.
    """
    from objslam.cli.run import objects_table, say_written
    from objslam.output.result_folder import write_result

    session.counters.ledger.add(feed.adapter.ledger)
    try:
        result = session.stop()
    except Exception as error:
        latest.write(session.snapshot())
        if session.failure is None:
            raise
        report(session.counters.ledger)
        raise _ended_early(session.failure, out, "there is no more of the map than objects.json, if that") from error
    removed = write_result(result, out, truth)
    last = session.snapshot()
    ledger = session.counters.ledger
    report(ledger)
    console().print(objects_table(result.map))
    counts = result.summary["counts"]
    resolved, thinned = counts["objects"] - counts["unresolved"], last.counters.get("keyframes left out", 0)
    more = f" ({thinned} more left out: live.max_keyframes)" if thinned else ""
    say(
        f"{resolved} object{'' if resolved == 1 else 's'} ({counts['unresolved']} unresolved) from {counts['rays']} rays "
        f"({counts['rays_unexplained']} of no object) in {counts['keyframes']} keyframes{more}; {times(last, ', ')}"
        f"{last.rebuilds} rebuilds"
    )
    say_written(out, removed)
    for view in feed.views if broken is None else ():
        view(last)
    if session.failure is not None:
        raise _ended_early(session.failure, out, "the map is of what came until then") from session.failure
    if broken is not None:
        raise broken


def _ended_early(failure: Exception, out: Path, map_: str) -> ObjslamError:
    from objslam.sources.journal.file import NAME

    said = one_line(failure)
    if not isinstance(failure, ObjslamError):
        said = f"internal error, {type(failure).__name__}: {said}"
    more = f"; `objslam run {out}` maps all that came" if (out / NAME).is_file() else ""
    return ObjslamError(f"the session ended early: {said}", hint=map_ + more)


@contextmanager
def _ends_by_signal(stop: threading.Event) -> Iterator[None]:
    """Ctrl-C and SIGTERM set stop; a second Ctrl-C ends at once."""

    def end(number: int, frame: object) -> None:
        if stop.is_set():
            raise KeyboardInterrupt
        stop.set()

    before = {number: signal.signal(number, end) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
