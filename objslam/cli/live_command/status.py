"""The status line of `objslam live`."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

from objslam.cli.console import console, say

if TYPE_CHECKING:
    from objslam.core.diagnostics import Ledger
    from objslam.core.snapshot import Snapshot

_LINES = 10.0  # The least time between two status lines if stderr is no terminal, s. A larger value prints fewer lines.


@contextmanager
def status_line(quiet: bool = False) -> Iterator[Callable[[Snapshot, Ledger], None]]:
    """Yield a function that shows the status line on stderr. The function takes a snapshot and the ledger of the adapter.

    On a terminal, the line is cut to the width of the terminal. Else the function prints at most one line in `_LINES` s. If
    `quiet` is True, the function shows nothing.
    """
    if quiet:
        yield lambda snapshot, ledger: None
        return
    from rich.live import Live as Line
    from rich.text import Text

    screen = console(stderr=True)
    rates = _Rates()
    if screen.is_terminal:
        with Line(console=screen, refresh_per_second=4, transient=True) as line:

            def show_line(snapshot: Snapshot, ledger: Ledger) -> None:
                text = rates.line(snapshot, ledger, screen.width)
                line.update(Text(text, no_wrap=True, overflow="ellipsis"))

            yield show_line
        return
    printed = time.monotonic()

    def print_line(snapshot: Snapshot, ledger: Ledger) -> None:
        nonlocal printed
        if time.monotonic() - printed >= _LINES:
            printed = time.monotonic()
            say(rates.line(snapshot, ledger), stderr=True)

    yield print_line


class _Rates:
    """The formatter of the status line. Message rates are averages since the previous status line.

    A narrow terminal cuts the end of the line, so long reasons come last. Less important parts are left out until the line
    fits as far as the number of dropped data.
    """

    def __init__(self) -> None:
        self._before: tuple[float, dict[str, int]] = (time.monotonic(), {})

    def line(self, snapshot: Snapshot, ledger: Ledger, width: int | None = None) -> str:
        """Return the status line, with the rates since the last call.

        width: the width of the terminal in characters. If it is None, no part of the line is left out.
        """
        now, then, before = time.monotonic(), *self._before
        self._before = (now, snapshot.counters)
        rates: dict[str, float] = {
            kind: (snapshot.counters.get(kind, 0) - before.get(kind, 0)) / max(now - then, 1e-3)
            for kind in ("odometry", "localization", "frames")
            if kind in snapshot.counters
        }
        for spare in range(4):
            line, needed = _status(snapshot, ledger, rates, spare)
            if width is None or needed <= width:
                break
        return line


def _status(snapshot: Snapshot, ledger: Ledger, rates: dict[str, float], spare: int) -> tuple[str, int]:
    """Return a status line, and its length up to and including the number of dropped data.

    spare: how much is left out. At 0, nothing is left out. At 1 and above, the number of unresolved objects is left out. At
    2 and above, the number of keyframes is left out as well. At 3, the rates of odometry and localisation become one rate.
    """
    resolved = len(snapshot.map.resolved())
    found = f"{resolved} object{'' if resolved == 1 else 's'}"
    if spare < 1:
        found += f", {len(snapshot.map) - resolved} unresolved"
    if spare >= 3 and len(rates) == 3:
        rates = {"poses": rates["odometry"] + rates["localization"], "frames": rates["frames"]}
    place = snapshot.in_map
    mapped = "" if place is None else f"localised by {place.objects} objects" if place.objects else "not localised yet"
    dropped, why = _lost(snapshot, ledger)
    parts = (
        found if snapshot.keyframes else "",
        " ".join(f"{kind} {rate:.0f}/s" for kind, rate in rates.items()) or "no messages yet",
        f"lag {1e3 * snapshot.lag:.0f} ms",
        f"{snapshot.keyframes} keyframe{'' if snapshot.keyframes == 1 else 's'}" if spare < 2 else "",
        mapped,
        f"dropped {dropped}",
    )
    line = " | ".join(part for part in parts if part)
    calibrations = snapshot.counters.get("calibrations", 0)
    more = (f"{calibrations} calibration{'' if calibrations == 1 else 's'}" if calibrations else "", times(snapshot, ""))
    return " | ".join([line + why, *(part for part in more if part)]), len(line)


def _lost(snapshot: Snapshot, ledger: Ledger) -> tuple[int, str]:
    """Return the number of dropped data, and a text. The text has the most frequent reason of a drop, and the number of
    unused data of each kind."""
    from objslam.core.snapshot import NOT_USED
    from objslam.frontend.bearings import CUT_OFF

    dropped = Counter(snapshot.dropped) + Counter(ledger.dropped)
    del dropped[CUT_OFF]  # Every camera has such boxes. The report at the end counts them.
    reason = f" ({dropped.most_common(1)[0][0]})" if dropped else ""
    unused = "".join(f", {n} {kind}" for kind, n in snapshot.counters.items() if kind.endswith(NOT_USED))
    return dropped.total(), reason + unused


def times(snapshot: Snapshot, then: str) -> str:
    """Return a text with the median and the 99th percentile of the update times, and with `then` at its end. Return "" if
    there were no updates."""
    median, most = snapshot.update
    return f"update p50 {1e3 * median:.1f} ms, p99 {1e3 * most:.1f} ms{then}" if most > 0 else ""
