"""Terminal output of the commands: lines, warnings, tables and progress."""

from __future__ import annotations

import functools
import os
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from textwrap import fill
from typing import TYPE_CHECKING, Any

from objslam.core.diagnostics import Ledger
from objslam.errors import printable

if TYPE_CHECKING:
    from rich.console import Console
    from rich.text import Text


_NEIGHBOURS = 3  # The most names of other files in a warning. A larger number makes the line longer.
Show = Callable[[str, int, int], None]
"""A function of the stage's name, the number of finished items, and the total number of items, 0 if unknown."""

_EVERY = 10.0
"""The time (s) between two looks at a running command, and before the first look. Each look prints new warnings and, if
stderr is not a terminal, a line of progress. A larger value prints fewer lines. `objslam live` prints its status line as
often. A command of a few seconds prints no progress, and one that fails at once prints one line."""


@dataclass
class SpeakingLedger(Ledger):
    """A ledger that can print its warnings while a command works. So a user need not wait for the end of a run to hear that
    the input is wrong. A run that starts again, with poses that are solved too, may take a warning back. told: the warnings
    that are printed already."""

    told: list[str] = field(default_factory=list)

    def speak(self) -> None:
        """Print the warnings that are not printed yet."""
        new = [one for one in self.warnings if one not in self.told]
        self.told += new
        _say_warnings(new)

    def taken_back(self) -> list[str]:
        """Return the warnings that are printed, and no longer in the ledger."""
        return [one for one in self.told if one not in self.warnings]


def report(ledger: Ledger) -> None:
    """Print each drop and warning of a ledger as one line on stderr, without the warnings that are printed already. Name the
    printed warnings that are no longer true."""
    told, back = (ledger.told, ledger.taken_back()) if isinstance(ledger, SpeakingLedger) else ([], [])
    _say_warnings([line for line in ledger.lines() if line not in told])
    for line in back:
        say(f"taken back, because the run could explain it: {line}", stderr=True)


def _say_warnings(lines: list[str]) -> None:
    for line in lines:
        say(f"warning: {line}", stderr=True)


@contextmanager
def progress_bar(ledger: SpeakingLedger | None = None, *, quiet: bool = False) -> Iterator[Show]:
    """Show the progress on stderr: as a bar on a terminal, else as a plain line now and then. Print warnings meanwhile.

    Yield a function that updates it. It takes the stage name, the number of finished items, and the total number of items, 0
    if unknown. The bar shows the time since the stage began, and how many items it finishes in a second. quiet: whether to
    print no lines of progress. ledger: its new warnings are printed every `_EVERY` seconds, also with `quiet`.
    """
    with _bar() if console(stderr=True).is_terminal else _lines(quiet) as (show, tell), _now_and_then(ledger, tell):
        yield show


@contextmanager
def _bar() -> Iterator[tuple[Show, Callable[[], None]]]:
    """Yield two functions. The first one updates the progress bar. The second one does nothing, because the bar itself shows
    the time."""
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        Progress,
        ProgressColumn,
        SpinnerColumn,
        Task,
        TextColumn,
        TimeElapsedColumn,
    )
    from rich.text import Text

    words = TextColumn("{task.description}", markup=False)

    class Rate(ProgressColumn):
        def render(self, task: Task) -> Text:
            return Text(f"{task.speed:.1f}/s" if task.speed else "")

    columns = (SpinnerColumn(), words, BarColumn(), MofNCompleteColumn(), TimeElapsedColumn(), Rate())
    with Progress(*columns, console=console(stderr=True), transient=True) as bar:
        shown = "reading"
        task = bar.add_task(shown, total=None)

        def show(stage: str, done: int, total: int) -> None:
            nonlocal shown, task
            if stage != shown:  # rich stops the clock of a finished task, and never forgets a total.
                bar.remove_task(task)
                shown, task = stage, bar.add_task(printable(stage), total=total or None)
            bar.update(task, completed=done, total=total or None)

        yield show, lambda: None


@contextmanager
def _lines(quiet: bool) -> Iterator[tuple[Show, Callable[[], None]]]:
    """Yield two functions. The first one takes the newest stage. The second one prints it, unless `quiet`."""
    begin, newest = time.monotonic(), ("reading", 0, 0)

    def show(stage: str, done: int, total: int) -> None:
        nonlocal newest
        newest = stage, done, total

    def tell() -> None:
        stage, done, total = newest
        count = f" {done} of {total}" if total else ""
        say(f"working for {time.monotonic() - begin:.0f} s: {stage}{count}", stderr=True)

    yield show, (lambda: None) if quiet else tell


@contextmanager
def _now_and_then(ledger: SpeakingLedger | None, tell: Callable[[], None]) -> Iterator[None]:
    """Print the new warnings and call `tell` every `_EVERY` seconds. This needs a thread, because a stage may last for
    minutes without a report of progress."""

    def work() -> None:
        while not ended.wait(_EVERY):
            if ledger is not None:
                ledger.speak()
            tell()

    ended = threading.Event()
    thread = threading.Thread(target=work, name="objslam progress", daemon=True)
    thread.start()
    try:
        yield
    finally:
        ended.set()
        thread.join()


def warn_of_neighbours(out: Path) -> None:
    """Warn if the folder of a result contains other files and no result yet, because the files of the result will be among
    them."""
    from objslam.output.result_folder import foreign_files

    if found := foreign_files(out):
        shown = ", ".join([*found[:_NEIGHBOURS], *(["..."] if len(found) > _NEIGHBOURS else [])])
        what = f"{out} holds other files ({shown}), and the files of the result would be among them"
        say(f"warning: {what} (-o names a folder of its own)", stderr=True)


def console(*, stderr: bool = False) -> Console:
    """Return the console of stdout or stderr. It has the width of the terminal, or COLUMNS. Without both it is 120 columns.

    Each stream has one console, so that a line printed during a progress bar or status line does not mix with it. The
    console has no markup: it prints [red] and :smile: as they are. `printable` replaces characters that cannot be printed.
    """
    return console_of(stderr)


@functools.cache
def console_of(stderr: bool, /) -> Console:
    """Return the one console of a stream. The cache takes `f(True)` and `f(stderr=True)` for two calls, so only `console`
    calls this."""
    from rich.console import Console

    class Plain(Console):
        def render_str(self, text: str, **options: Any) -> Text:
            return super().render_str(printable(text), **options)

    return Plain(stderr=stderr, highlight=False, markup=False, emoji=False, width=None if _is_narrow(stderr) else 120)


def width(*, stderr: bool = False) -> int | None:
    """Return how many characters a line of stdout or stderr has: the width of the terminal, or COLUMNS. None for any other
    pipe."""
    return console(stderr=stderr).width if _is_narrow(stderr) else None


def say(text: str, *, stderr: bool = False, style: str | None = None) -> None:
    """Print a sentence, wrapped between words if lines have a width (`width`).

    A longer word, such as a path, stays whole. rich would cut it. style: as rich names it, such as "bold".
    """
    most = width(stderr=stderr)
    lines = text.split("\n")
    if most is not None:
        lines = [fill(line, most, break_long_words=False, break_on_hyphens=False) for line in lines]
    put("\n".join([*lines, ""]), stderr=stderr, style=style)


def put(text: str, *, stderr: bool = False, style: str | None = None) -> None:
    """Print a text that is not wrapped: data for programs, or a command to copy. The text ends its own lines."""
    console(stderr=stderr).print(text, style=style, end="", soft_wrap=True)


def _is_narrow(stderr: bool) -> bool:
    return (sys.stderr if stderr else sys.stdout).isatty() or os.environ.get("COLUMNS", "").isdigit()
