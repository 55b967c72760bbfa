"""Terminal output of the commands: lines, warnings, tables and a progress bar."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rich.console import Console

    from objslam.core.diagnostics import Ledger


@contextmanager
def progress_bar() -> Iterator[Callable[[str, int, int], None]]:
    """Show a progress bar if stderr is a terminal. Yield a function that updates the bar.
    It takes the stage name, the number of finished items, and the total number of items, 0 if unknown."""
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, SpinnerColumn, TextColumn, TimeElapsedColumn

    columns = (SpinnerColumn(), TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    screen = console(stderr=True)
    with Progress(*columns, console=screen, transient=True, disable=not screen.is_terminal) as bar:
        task = bar.add_task("reading")
        yield lambda stage, done, total: bar.update(task, description=stage, completed=done, total=total or None)


def report(ledger: Ledger) -> None:
    """Print each drop and warning of a ledger as one line on stderr."""
    for line in ledger.lines():
        say(f"warning: {line}", stderr=True)


def console(stderr: bool = False) -> Console:
    """Return a console with the width of the terminal, or with 120 columns if stdout is not a terminal."""
    from rich.console import Console

    return Console(stderr=stderr, highlight=False, width=None if sys.stdout.isatty() else 120)


def say(text: str, *, stderr: bool = False, markup: bool = False, end: str = "\n") -> None:
    """Print a text without wrapping."""
    console(stderr).print(text, markup=markup, end=end, soft_wrap=True)
