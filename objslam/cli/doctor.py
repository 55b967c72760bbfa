"""The command `objslam doctor`, which looks for wrong input in a log and says what is probably wrong."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from objslam.cli.console import console, progress_bar, report, say
from objslam.cli.options import Config, Mode, Set, settings_of, with_options
from objslam.sources import SourceOptions, read

if TYPE_CHECKING:
    from objslam.config import Settings
    from objslam.core.types import Log
    from objslam.mapping.checks.diagnosis import Diagnosis
    from objslam.mapping.progress import Progress

SPOILT = 1
"""The exit code if the input has an error that makes the positions of a map unreliable."""
_ROWS = 8  # The largest number of hypotheses in the table, besides the log as it is. The other hypotheses explain less.


@with_options
def doctor(
    log: Annotated[Path, typer.Argument(help="A log folder, a ROS bag, or another recording that `objslam info` reads.")],
    mode: Mode = None,
    config: Config = None,
    set_: Set = None,
    *,
    options: SourceOptions,
) -> None:
    """Look for wrong units, axes, stamps, boxes and calibrations in a log. Nothing is changed, and nothing is written.

    The exit code is 1 if the input has an error that makes the positions of a map unreliable.
    """
    from objslam.core.diagnostics import Ledger
    from objslam.frontend.boxes.ignored_labels import without_ignored_labels
    from objslam.frontend.boxes.robot_parts import without_robot_parts
    from objslam.frontend.boxes.second_labels import without_second_labels
    from objslam.frontend.known_errors import take_out_expected
    from objslam.frontend.localization.odometry_clock import at_one_clock
    from objslam.mapping.checks.assessment import lost_input, malformed_frames
    from objslam.mapping.checks.diagnosis import diagnose
    from objslam.mapping.chosen_poses import with_chosen_poses, with_mode_of
    from objslam.mapping.fixed.sparse_noise import with_sparse_noise
    from objslam.mapping.ground.uneven_ground import with_uneven_ground
    from objslam.sources.camera_words import doubts_of

    settings = settings_of(mode, config, set_)
    ledger = Ledger()
    with progress_bar() as show:
        given = read(log, ledger, options)
        mapped = without_ignored_labels(given, settings, ledger)
        chosen, _ = at_one_clock(with_chosen_poses(mapped, settings, ledger), settings, ledger)
        chosen = without_robot_parts(chosen, settings, ledger)
        chosen = without_second_labels(chosen, settings, ledger)
        settings = with_mode_of(chosen, settings)
        said = take_out_expected(chosen, settings)
        settings = with_uneven_ground(said, settings, ledger, show)
        found = diagnose(said, settings, ledger, show, thorough=True)
        settings, found = with_sparse_noise(said, settings, found, ledger, show)
        solved = _solved(given, settings, show) if found.refutable and settings.mode == "joint" else None
    report(ledger)
    _show_trials(found)
    wrong = [finding.to_dict() for finding in found.findings] if solved is None else solved
    for finding in wrong:
        say(f"wrong: {finding['message']}")
    # The boxes show whether a calibration is right. Without enough boxes, only its unusual properties can be shown.
    frames = sum(len(c.detections.frame_stamps) for c in given.cameras if c.detections is not None)
    doubts = lost_input(ledger.unused, malformed_frames(ledger.dropped), frames)
    doubts += [] if found.trials else [doubt for c in given.cameras for doubt in doubts_of(c.camera)]
    for doubt in doubts:
        say(f"check: {doubt}")
    if not wrong and not doubts:
        refuted = ": the boxes fit poorly at the given poses, but agree after the joint solve" if found.findings else ""
        say(f"nothing wrong was found{refuted}")
    if any(finding["spoils_positions"] for finding in wrong):
        raise typer.Exit(SPOILT)


def _solved(log: Log, settings: Settings, show: Progress) -> list[dict[str, Any]] | None:
    """Return the findings that remain after a run has solved the poses, in the form of summary.json. Return None if the
    solve fails."""
    from objslam.core.diagnostics import Ledger
    from objslam.errors import SolveError
    from objslam.mapping.pipeline import run

    quiet: dict[str, object] = {"output": settings.output.model_copy(update={"recording": False})}
    quiet["reconstruction"] = settings.reconstruction.model_copy(update={"use": False})
    try:
        result = run(log, settings.model_copy(update=quiet), Ledger(), show)
    except SolveError:
        return None
    found: list[dict[str, Any]] = result.summary["wrong_input"]
    return found


def _show_trials(found: Diagnosis) -> None:
    """Print a table of how well the boxes fit: with the log as it is, and with the corrections that make them fit best.

    Such a correction is called a hypothesis. If there is no finding, or if no boxes were compared, print one line instead.
    """
    from rich.table import Table

    if not found.trials:
        say(f"how well the boxes agree is not judged: {found.uncompared or 'no two of them can be compared'}")
        return
    if not found.findings:
        first, *others = found.trials
        better = " clearly" if any(trial.score > first.score for trial in others) else ""
        share = f"{100 * first.share:.0f} % of the boxes fit the log as it is"
        say(f"{share}; no correction fits{better} better ({len(others)} tried)")
        return
    table = Table(title="how well the boxes fit")
    for name in ("what if", "boxes that fit", "score", "drives where it heads"):
        table.add_column(name, justify="left" if name == "what if" else "right")
    for trial in found.trials[: _ROWS + 1]:
        what = "the log as it is" if trial.hypothesis is None else f"with {trial.hypothesis.what}"
        straight = "" if trial.straight is None else f"{100 * trial.straight:.0f} %"
        table.add_row(what, f"{100 * trial.share:.0f} %", f"{trial.score:.2f}", straight)
    console().print(table)
