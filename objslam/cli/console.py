"""Terminal output of the commands: lines, warnings, tables and a progress bar."""

from __future__ import annotations

import functools
import os
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from textwrap import fill
from typing import TYPE_CHECKING, Any

from objslam.errors import printable

if TYPE_CHECKING:
    from rich.console import Console
    from rich.text import Text

    from objslam.core.diagnostics import Ledger

_NEIGHBOURS = 3  # The most names of other files in a warning. A larger number makes the line longer.


@contextmanager
def progress_bar() -> Iterator[Callable[[str, int, int], None]]:
    """Show a progress bar if stderr is a terminal. Yield a function that updates the bar.

    It takes the stage name, the number of finished items, and the total number of items, 0 if unknown. The bar shows the
    time since the stage began, and how many items it finishes in a second.
    """
    screen = console(stderr=True)
    if not screen.is_terminal:
        yield lambda stage, done, total: None
        return
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
    with Progress(*columns, console=screen, transient=True) as bar:
        shown = "reading"
        task = bar.add_task(shown, total=None)

        def show(stage: str, done: int, total: int) -> None:
            nonlocal shown, task
            if stage != shown:  # rich stops the clock of a finished task, and never forgets a total.
                bar.remove_task(task)
                shown, task = stage, bar.add_task(printable(stage), total=total or None)
            bar.update(task, completed=done, total=total or None)

        yield show


def report(ledger: Ledger) -> None:
    """Print each drop and warning of a ledger as one line on stderr."""
    for line in ledger.lines():
        say(f"warning: {line}", stderr=True)


def warn_of_neighbours(out: Path) -> None:
    """Warn if the folder of a result holds other files and no result yet: the files of the result will stand among them."""
    from objslam.output.result_folder import foreign_files

    if found := foreign_files(out):
        shown = ", ".join([*found[:_NEIGHBOURS], *(["..."] if len(found) > _NEIGHBOURS else [])])
        what = f"{out} holds other files ({shown}), and the files of the result go among them"
        say(f"warning: {what} (-o names a folder of its own)", stderr=True)


def console(*, stderr: bool = False) -> Console:
    """Return the console of stdout or stderr. Its width is that of the terminal, or COLUMNS. Without both it is 120 columns.

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
