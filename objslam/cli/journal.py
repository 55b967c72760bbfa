"""The commands `objslam journal verify|repair|export`, for the journal of a live session."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from objslam.cli.console import console, report, say

if TYPE_CHECKING:
    from objslam.sources.journal.maintenance import Check

journal_app = typer.Typer(no_args_is_help=True, help="Check, repair and export the journal of a live session.")
Journal = Annotated[Path, typer.Argument(metavar="JOURNAL", help="journal.objslam, or the folder that holds it.")]


@journal_app.command()
def verify(journal: Journal) -> None:
    """Check every segment of a journal. The exit code is 1 if a segment is damaged or missing."""
    from objslam.errors import LogError
    from objslam.sources.journal import maintenance

    checks = maintenance.verify(journal)
    _show(checks)
    bad = [check.path.name for check in checks if not check.sound]
    if bad:
        hint = "`objslam journal repair` leaves out what is damaged"
        raise LogError(f"damaged or missing: {', '.join(bad)}", where=str(journal), hint=hint)
    say(f"{sum(check.records for check in checks)} records, no damage")


@journal_app.command()
def repair(journal: Journal) -> None:
    """Remove the damaged parts of a journal, so that the rest is sound. The damaged files are kept under other names."""
    from objslam.sources.journal import maintenance

    made = maintenance.repair(journal)
    for path in made:
        say(f"wrote {path}")
    if not made:
        say("there is nothing to repair")


@journal_app.command()
def export(
    journal: Journal,
    out: Annotated[Path, typer.Option("-o", "--out", help="The file to write.")] = Path("journal.jsonl"),
) -> None:
    """Write the messages as JSON lines, for `objslam live stdin`. For a log folder: `objslam convert JOURNAL LOG`."""
    from collections import Counter

    from objslam.core.diagnostics import Ledger
    from objslam.io.atomic_files import write_lines
    from objslam.sources.journal.maintenance import json_lines

    ledger, left_out = Ledger(), Counter[str]()
    write_lines(out, json_lines(journal, ledger, left_out))
    report(ledger)
    if left_out:
        kinds = ", ".join(f"{count} {kind}" for kind, count in left_out.items())
        say(f"left out, because only a journal can hold it: {kinds}", stderr=True)
    say(f"wrote {out}")


def _show(checks: list[Check]) -> None:
    from rich.table import Table

    table = Table(title="segments")
    for name in ("file", "format", "bytes", "records", "damaged bytes", "from s", "to s"):
        table.add_column(name, justify="left" if name == "file" else "right", overflow="fold")
    for check in checks:
        words = "missing" if not check.size else "unreadable" if not check.format else str(check.format)
        stamps = ["" if stamp is None else f"{stamp:.3f}" for stamp in (check.start, check.end)]
        table.add_row(check.path.name, words, *(str(n) for n in (check.size, check.records, check.damaged)), *stamps)
    console().print(table)
