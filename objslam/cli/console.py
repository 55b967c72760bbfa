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


_NEIGHBOURS = 3  # The largest number of other files that a warning names. A larger number makes the line longer.
Show = Callable[[str, int, int], None]
"""A function that takes the name of a stage, the number of finished items, and the number of all items (0 if unknown)."""

_EVERY = 10.0
"""The time from the start of a command to its first report, and from one report to the next, s. A report prints the new
warnings. If stderr is not a terminal, it also prints a line of progress. A larger value prints fewer lines. `objslam live`
prints its status line at the same interval. A command of a few seconds prints no progress. A command that fails at once
prints one line."""


@dataclass
class SpeakingLedger(Ledger):
    """A ledger that can print its warnings while a command works. A user need not wait for the end of a run to learn that
    the input is wrong. A run may start again in order to solve the poses. This second attempt may take a warning back.
    told: the warnings that are printed already."""

    told: list[str] = field(default_factory=list)

    def speak(self) -> None:
        """Print the warnings that are not printed yet."""
        new = [one for one in self.warnings if one not in self.told]
        self.told += new
        _say_warnings(new)

    def taken_back(self) -> list[str]:
        """Return the warnings that were printed but are no longer in the ledger."""
        return [one for one in self.told if one not in self.warnings]


def report(ledger: Ledger) -> None:
    """Print each drop and warning of a ledger as one line on stderr. Leave out the warnings that are printed already. Name
    the printed warnings that were taken back."""
    told, back = (ledger.told, ledger.taken_back()) if isinstance(ledger, SpeakingLedger) else ([], [])
    _say_warnings([line for line in ledger.lines() if line not in told])
    for line in back:
        say(f"taken back, because the run could explain it: {line}", stderr=True)


def _say_warnings(lines: list[str]) -> None:
    for line in lines:
        say(f"warning: {line}", stderr=True)


@contextmanager
def progress_bar(ledger: SpeakingLedger | None = None, *, quiet: bool = False) -> Iterator[Show]:
    """Show the progress on stderr: as a bar on a terminal, else as a plain line every `_EVERY` seconds.

    Yield the function that updates the progress. It takes the name of the stage, the number of finished items, and the
    number of all items (0 if unknown). The bar shows the time since the start of the stage, and the number of items finished
    per second. ledger: the ledger whose new warnings are printed every `_EVERY` seconds. quiet: whether to print no lines of
    progress. Warnings are printed even if `quiet` is True.
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
            if stage != shown:  # A stage needs a new task: rich stops the clock of a finished task and keeps its total.
                bar.remove_task(task)
                shown, task = stage, bar.add_task(printable(stage), total=total or None)
            bar.update(task, completed=done, total=total or None)

        yield show, lambda: None


@contextmanager
def _lines(quiet: bool) -> Iterator[tuple[Show, Callable[[], None]]]:
    """Yield two functions. The first one stores the newest progress. The second one prints it, unless `quiet` is True."""
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
    """Warn if the folder for a result contains other files and no older result. The files of the result would be among the
    other files."""
    from objslam.output.result_folder import foreign_files

    if found := foreign_files(out):
        shown = ", ".join([*found[:_NEIGHBOURS], *(["..."] if len(found) > _NEIGHBOURS else [])])
        what = f"{out} holds other files ({shown}), and the files of the result would be among them"
        say(f"warning: {what} (-o names a folder of its own)", stderr=True)


def console(*, stderr: bool = False) -> Console:
    """Return the console of stdout or stderr. Its width is COLUMNS, else the width of the terminal, else 120 characters.

    Each stream has one console, so that printed lines do not mix with a progress bar or a status line. The console has no
    markup: it prints [red] and :smile: as they are. `printable` replaces characters that cannot be printed.
    """
    return console_of(stderr)


@functools.cache
def console_of(stderr: bool, /) -> Console:
    """Return the only console of a stream. Only `console` may call this function, because the cache treats `f(True)` and
    `f(stderr=True)` as different calls."""
    from rich.console import Console

    class Plain(Console):
        def render_str(self, text: str, **options: Any) -> Text:
            return super().render_str(printable(text), **options)

    return Plain(stderr=stderr, highlight=False, markup=False, emoji=False, width=None if _is_narrow(stderr) else 120)


def width(*, stderr: bool = False) -> int | None:
    """Return the number of characters in a line of stdout or stderr: COLUMNS, else the width of the terminal. Return None if
    the stream is not a terminal and COLUMNS is not set."""
    return console(stderr=stderr).width if _is_narrow(stderr) else None


def say(text: str, *, stderr: bool = False, style: str | None = None) -> None:
    """Print a sentence. If lines have a width (`width`), the sentence is wrapped between words.

    A word that is longer than a line, such as a path, stays whole. rich would cut it. style: a rich style, such as "bold".
    """
    most = width(stderr=stderr)
    lines = text.split("\n")
    if most is not None:
        lines = [fill(line, most, break_long_words=False, break_on_hyphens=False) for line in lines]
    put("\n".join([*lines, ""]), stderr=stderr, style=style)


def put(text: str, *, stderr: bool = False, style: str | None = None) -> None:
    """Print a text without wrapping it, such as data for programs or a command to copy. No line end is added."""
    console(stderr=stderr).print(text, style=style, end="", soft_wrap=True)


def _is_narrow(stderr: bool) -> bool:
    return (sys.stderr if stderr else sys.stdout).isatty() or os.environ.get("COLUMNS", "").isdigit()
