"""The command `objslam explain`, which says what is doubtful in a result."""

from __future__ import annotations

import json as json_text
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from objslam.cli.console import console, put, say
from objslam.cli.options import Json

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from rich.table import Table

    from objslam.core.result import Doubt, DoubtKind

_TITLES: dict[DoubtKind, str] = {
    "pair": "objects that may be one",
    "split": "objects that may be several things, or none",
    "moved": "objects that were there for a time",
    "unresolved": "objects without a position",
    "unsure": "objects with a wide sigma",
    "boxes": "boxes that became no object",
    "label": "labels without an object",
}


def explain(
    out: Annotated[Path, typer.Argument(help="A result folder.")],
    label: Annotated[str | None, typer.Option("--label", help="Only objects and boxes with this label.")] = None,
    json: Json = False,
) -> None:
    """Say what is doubtful in a result, and why. For example, two objects may be one, or boxes became no object."""
    from objslam.errors import ConfigError, OutputError
    from objslam.io.results.files import DOUBTS, SUMMARY
    from objslam.io.results.read import load_doubts, load_summary

    doubts = load_doubts(out)
    if doubts is None:
        raise OutputError(f"this result has no {DOUBTS}", where=str(out), hint="an older version wrote it: run it again")
    summary = load_summary(out)
    cut: dict[str, int] = summary.get("cut_off", {})
    if label is not None and label not in (known := _labels(out, doubts, cut)):
        there = f"there are {', '.join(known)}" if known else "there are none"
        if summary.get("dropped"):
            there += f"; boxes that give no ray are counted as dropped in {SUMMARY}"
        raise ConfigError(f"no object, box or doubt has the label {label}", where=str(out), hint=there)
    chosen = [one for one in doubts if label is None or one.label == label]
    if json:
        put(json_text.dumps([one.to_dict() for one in chosen], indent=2, ensure_ascii=False) + "\n")
        return
    if not chosen:
        say("no doubts" if label is None else f"no doubts about {label}")
    for kind, title in _TITLES.items():
        if mine := [one for one in chosen if one.kind == kind]:
            console().print(doubts_table(mine, title))
    if label in cut:
        say(
            f"the image's edge cuts off {cut[label]} boxes of {label}, so they give no rays (rays.border, rays.border_share)"
        )
    if label is None and (left := summary.get("counts", {}).get("rays_unexplained")):
        grouped = sum(len(one.rays) for one in chosen if one.kind == "boxes")
        where = f"{grouped} in these groups, and {left - grouped} scattered" if grouped else "all scattered"
        say(f"{left} boxes became no object: {where}")


def _labels(out: Path, doubts: Sequence[Doubt], cut: Iterable[str]) -> list[str]:
    """Return the labels of the result's objects, boxes and doubts, in the order of the alphabet.

    cut: the labels of the boxes that the image's edge cuts off.
    """
    from objslam.io.results.read import load_map, load_rays

    boxes = load_rays(out).label.tolist()
    return sorted({*(o.label for o in load_map(out)), *boxes, *cut, *(one.label for one in doubts)})


def doubts_table(doubts: Sequence[Doubt], title: str) -> Table:
    """Return a table of the doubts of one kind. A row has the label of a doubt, and the sentence that explains it."""
    from rich.table import Table

    table = Table(title=title, show_lines=len(doubts) > 1)
    table.add_column("label", overflow="fold", min_width=8)
    table.add_column("doubt", overflow="fold", ratio=1)
    for one in doubts:
        table.add_row(one.label, one.text)
    return table
