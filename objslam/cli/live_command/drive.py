"""The main loop of `objslam live`. It runs the source, updates objects.json, and writes the map at the end, even after
errors."""

from __future__ import annotations

import signal
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from objslam.cli.console import report, say
from objslam.cli.live_command.status import status_line, times
from objslam.errors import ObjslamError, OutputError, is_out_of_memory, one_line
from objslam.io.threads import start_thread

if TYPE_CHECKING:
    from objslam.core.result import RunResult
    from objslam.core.snapshot import Snapshot
    from objslam.core.types import Truth
    from objslam.live.adapters import Feed
    from objslam.live.session.session import Session

_ENDING = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)  # The signals that end a session with a whole result.
_POLL = 0.1
"""The time between two checks for the end of the source, and between two ticks of the feed, s. With a larger value, the
session reacts later."""


class LatestObjects:
    """The writer of objects.json during a session. Its first write removes an older result."""

    def __init__(self, out: Path) -> None:
        self._out, self._begun, self._refused = out, False, False

    def try_write(self, snapshot: Snapshot) -> None:
        """Write as `write` does, but warn of an OutputError instead of raising it. Errors in a row give only one warning.
        Say when objects.json can be written again."""
        refused = None
        try:
            self.write(snapshot)
        except OutputError as error:
            refused = error
        if refused is not None and not self._refused:
            say(f"warning: {refused}; the mapping goes on", stderr=True)
        elif refused is None and self._refused:
            say(f"objects.json can be written again into {self._out}", stderr=True)
        self._refused = refused is not None

    def write(self, snapshot: Snapshot) -> None:
        """Write the objects of a snapshot, unless the session has no keyframe yet."""
        from objslam.io.atomic_files import write_file
        from objslam.io.objects_json import dump_objects
        from objslam.io.results.files import OBJECTS
        from objslam.output.result_folder import clear_result

        if snapshot.keyframes and not self._begun:
            self._begun = True
            if removed := clear_result(self._out):
                say(f"removed the older result from {self._out}: {', '.join(removed)}", stderr=True)
        if self._begun:
            write_file(self._out / OBJECTS, dump_objects(snapshot.map).encode())


def drive(session: Session, feed: Feed, latest: LatestObjects, interval: float, quiet: bool = False) -> Exception | None:
    """Run the adapter until it ends, the session fails, or the user presses Ctrl-C.

    Every `interval` s, update objects.json, the views and, unless `quiet` is True, the status line. Ten times a second, call
    the ticks of the feed and print new warnings. An error of a view or a tick also ends the loop. This error is returned
    instead of raised, so that `finish` can write the map first. An error of the adapter gives only a warning.
    """
    from objslam.live.session import low_latency

    low_latency.configure()
    stop, ended, broken, localised = threading.Event(), list[Exception](), None, False

    def bring() -> None:
        try:
            feed.adapter.run(stop)
        except Exception as error:  # noqa: BLE001 - reported below by the main thread
            ended.append(error)

    bringing = threading.Thread(target=bring, name="objslam adapter", daemon=True)
    ledgers, shown = (feed.adapter.ledger, session.counters.ledger), [0, 0]
    with _ends_by_signal(stop), status_line(quiet) as show:
        start_thread(bringing)
        due = time.monotonic() + interval
        try:
            while bringing.is_alive() and not stop.is_set() and session.failure is None:
                bringing.join(_POLL)
                for tick in feed.ticks:
                    tick()
                for i, ledger in enumerate(ledgers):
                    for warning in ledger.warnings[shown[i] :]:
                        shown[i] += 1
                        say(f"warning: {warning}", stderr=True)
                if time.monotonic() >= due:
                    due = time.monotonic() + interval
                    snapshot = session.snapshot()
                    found = snapshot.in_map is not None and snapshot.in_map.objects > 0
                    if snapshot.in_map is not None and found and not localised:
                        say(snapshot.in_map.line, stderr=True)
                    localised = found
                    latest.try_write(snapshot)
                    for view in feed.views:
                        view(snapshot)
                    show(snapshot, feed.adapter.ledger)
        except Exception as error:  # noqa: BLE001 - raised by `finish` after the map is written
            broken = error
        stop.set()
        bringing.join()
    if ended:
        say(f"warning: the source ended: {one_line(ended[0])}", stderr=True)
    return broken


def finish(
    session: Session,
    feed: Feed,
    out: Path,
    latest: LatestObjects,
    truth: Truth | None,
    broken: Exception | None,
    quiet: bool = False,
) -> RunResult:
    """End the session, write its result, and return it. Print a summary unless `quiet` is True.

    broken: the error that `drive` returned, or None. If the session ended early, its error is raised as an ObjslamError
    after the result is written. Else `broken` is raised. If there is no result, the last snapshot is written to
    objects.json.
    """
    from objslam.cli.run import say_result
    from objslam.core.snapshot import CAME_BEFORE, TOO_SLOW
    from objslam.output.result_folder import write_result

    session.counters.ledger.add(feed.adapter.ledger)
    try:
        result = session.stop()
    except Exception as error:
        latest.write(session.snapshot())
        if session.failure is None:
            raise
        report(session.counters.ledger)
        raise _ended_early(session.failure, out, "there is no result, but objects.json may hold the last map") from error
    removed = write_result(result, out, truth)
    last = session.snapshot()
    report(session.counters.ledger)
    if TOO_SLOW in last.dropped and (advice := feed.late()):
        say(f"warning: {advice}", stderr=True)
    if again := sum(n for kind, n in last.counters.items() if kind.endswith(CAME_BEFORE)):
        say(f"{again} poses and frames came a second time. They are in the map already, so nothing is lost", stderr=True)
    thinned = last.counters.get("keyframes left out", 0)
    more = f" ({thinned} more left out: live.max_keyframes)" if thinned else ""
    if not quiet:
        say_result(result, f"{more}; {times(last, ', ')}{last.rebuilds} rebuilds", out, removed)
    for view in feed.views if broken is None else ():
        view(last)
    if session.failure is not None:
        raise _ended_early(session.failure, out, "the map covers the messages until then") from session.failure
    if broken is not None:
        raise broken
    return result


def _ended_early(failure: Exception, out: Path, map_: str) -> ObjslamError:
    from objslam.sources.journal.record_format import NAME

    internal = "" if isinstance(failure, ObjslamError) else f"internal error, {type(failure).__name__}: "
    cause = "out of memory" if is_out_of_memory(failure) else f"{internal}{one_line(failure)}"
    more = f"; `objslam run {out}` maps all received messages" if (out / NAME).is_file() else ""
    return ObjslamError(f"the session ended early: {cause}", hint=map_ + more)


@contextmanager
def _ends_by_signal(stop: threading.Event) -> Iterator[None]:
    """Set `stop` at Ctrl-C, at SIGTERM, or when the terminal closes (SIGHUP). A second signal raises KeyboardInterrupt.

    A signal that the process ignores stays ignored. For example, nohup makes a process ignore SIGHUP.
    """

    def end(number: int, frame: object) -> None:
        if stop.is_set():
            raise KeyboardInterrupt
        stop.set()

    heard = (number for number in _ENDING if signal.getsignal(number) != signal.SIG_IGN)
    before = {number: signal.signal(number, end) for number in heard}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
