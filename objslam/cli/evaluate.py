"""The command `objslam eval`, which compares a result with the truth."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from objslam.cli.console import console, put
from objslam.cli.options import Align, Json, Quiet, Radius

if TYPE_CHECKING:
    from objslam.evaluation.evaluate_folder import AlignmentChoice


def evaluate_result(
    out: Annotated[Path, typer.Argument(help="A result folder.")],
    truth: Annotated[
        Path | None,
        typer.Option("--truth", help="objects.json, or a groundtruth, log or result folder. Default: the truth of the log."),
    ] = None,
    align: Align = "auto",
    radius: Radius = 0.5,
    quiet: Quiet = False,
    json: Json = False,
) -> None:
    """Compare a result with the ground truth. Print matched, missed and false objects, and errors of positions and path."""
    print_evaluation(out, truth, align, radius, json, quiet)


def print_evaluation(
    out: Path, truth: Path | None, align: AlignmentChoice, radius: float, json: bool = False, quiet: bool = False
) -> None:
    """Evaluate a result folder, write evaluation.json into the folder, and print a table.

    json: whether to print the content of evaluation.json instead of the table. quiet: whether to print nothing.
    """
    from objslam.evaluation.evaluate_folder import evaluate_folder, write_evaluation
    from objslam.evaluation.table import evaluation_table
    from objslam.io.results.files import dump_json

    found = evaluate_folder(out, truth, align=align, radius=radius)
    write_evaluation(found, out)
    if quiet:
        return
    if json:
        put(dump_json(found.to_dict()))
    else:
        console().print(evaluation_table(found))
