"""The status line of `objslam live`."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

from objslam.cli.console import console, say

if TYPE_CHECKING:
    from objslam.core.snapshot import Snapshot

_LINES = 10.0  # The time in s between two status lines if stderr is not a terminal.


@contextmanager
def status_line() -> Iterator[Callable[[Snapshot], None]]:
    """Yield a function that shows a snapshot in the status line on stderr. If stderr is not a terminal, the function prints
    at most one line in ten seconds."""
    from rich.live import Live as Line

    screen = console(stderr=True)
    rates = _Rates()
    if screen.is_terminal:
        with Line(console=screen, refresh_per_second=4, transient=True) as line:
            yield lambda snapshot: line.update(rates.line(snapshot))
        return
    printed = time.monotonic()

    def print_line(snapshot: Snapshot) -> None:
        nonlocal printed
        if time.monotonic() - printed >= _LINES:
            printed = time.monotonic()
            say(rates.line(snapshot), stderr=True)

    yield print_line


class _Rates:
    """The formatter of the status line. Message rates are averages since the previous status line."""

    def __init__(self) -> None:
        self._before: tuple[float, dict[str, int]] = (time.monotonic(), {})

    def line(self, snapshot: Snapshot) -> str:
        now, then, before = time.monotonic(), *self._before
        self._before = (now, snapshot.counters)
        rates = {
            kind: (snapshot.counters.get(kind, 0) - before.get(kind, 0)) / max(now - then, 1e-3)
            for kind in ("odometry", "localization", "frames")
            if kind in snapshot.counters
        }
        shown = " ".join(f"{kind} {rate:.0f}/s" for kind, rate in rates.items()) or "no messages yet"
        resolved = len(snapshot.map.resolved())
        calibrated = f"{n} calibrations | " if (n := snapshot.counters.get("calibrations", 0)) else ""
        return (
            f"{shown} | lag {1e3 * snapshot.lag:.0f} ms | dropped {sum(snapshot.dropped.values())} | "
            f"{snapshot.keyframes} keyframes | {calibrated}{times(snapshot, ' | ')}"
            f"{resolved} objects, {len(snapshot.map) - resolved} unresolved"
        )


def times(snapshot: Snapshot, then: str) -> str:
    """Return a text of median and 99th percentile of the update times, then `then`. It is empty if no update was timed."""
    median, most = snapshot.update
    return f"update p50 {1e3 * median:.1f} ms, p99 {1e3 * most:.1f} ms{then}" if most > 0 else ""
