"""The command `objslam calibrate`, which estimates the shared errors of a robot from one or several logs."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from objslam.cli.console import SpeakingLedger, console, progress_bar, report, say
from objslam.cli.options import Config, Set, settings_of, with_options
from objslam.sources import SourceOptions

if TYPE_CHECKING:
    from objslam.config import Settings
    from objslam.core.calibration import Calibration
    from objslam.core.diagnostics import Ledger
    from objslam.mapping.progress import Progress


@with_options
def calibrate(
    logs: Annotated[list[Path], typer.Argument(metavar="LOG...", help="Logs of one robot, as for `objslam run`.")],
    out: Annotated[Path, typer.Option("-o", "--out", help="The calibration file to write.")] = Path("calibration.yaml"),
    mode: Annotated[
        Literal["fixed", "joint"] | None,
        typer.Option(
            "--mode",
            help="joint (the default): calibrate odometry and cameras. fixed: calibrate cameras at the poses of a "
            "localisation.",
        ),
    ] = None,
    config: Config = None,
    set_: Set = None,
    *,
    options: SourceOptions,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace an existing calibration file.")] = False,
) -> None:
    """Estimate the errors that all measurements of a robot share, for `objslam run --calibration FILE`.

    If there are several logs, a log that cannot be used is left out with a warning.
    """
    from objslam.cli.run import calibration_table
    from objslam.core.calibration import combine
    from objslam.errors import ConfigError, LogError, ObjslamError
    from objslam.io.atomic_files import write_file
    from objslam.io.calibration_yaml import dump_calibration, load_calibration

    settings = settings_of(mode or "joint", config, ["output.recording=false", *(set_ or ())])
    if settings.calibration.use is False:
        raise ConfigError("nothing to calibrate", hint="leave out calibration.use=false")
    if settings.mode == "fixed":
        settings = settings.model_copy(update={"calibration": settings.calibration.model_copy(update={"use": True})})
    _check_target(out, overwrite)
    found: list[Calibration] = []
    failed: list[ObjslamError] = []
    for number, log in enumerate(logs, start=1):
        ledger = SpeakingLedger()
        try:
            with progress_bar(ledger) as show:
                found.append(_calibrate(log, options, settings, ledger, _of_several(show, number, len(logs))))
        except ObjslamError as error:
            if len(logs) == 1:
                raise
            failed.append(error)
            ledger.warn(f"{log} is left out: {error}")
        report(ledger)
    if not found:
        raise LogError(f"none of the {len(logs)} logs can be used", hint="the warnings say why")
    # The file is the prior of all logs. Errors that only the file has are also in the result.
    if settings.calibration.file is not None:
        known = load_calibration(Path(settings.calibration.file)).of_robot()
        found.insert(0, replace(known, prior=known.sigma, prior_mean=known.values, prior_covariance=known.covariance))
    together = combine(found)
    console().print(calibration_table(together.to_dict()))
    write_file(out, dump_calibration(together).encode())
    left_out = f" ({len(failed)} left out)" if failed else ""
    used = len(logs) - len(failed)
    say(f"wrote {out}, from {used} log{'' if used == 1 else 's'}{left_out}")


def _calibrate(path: Path, options: SourceOptions, settings: Settings, ledger: Ledger, show: Progress) -> Calibration:
    """Return the shared errors in one log. Raises ConfigError if the log lacks the poses that the settings need, and
    SolveError if the estimation fails."""
    from objslam.errors import ConfigError, SolveError
    from objslam.mapping import pipeline
    from objslam.sources import read

    log = read(path, ledger, options)
    if settings.mode == "fixed" and log.localization is None:
        hint = "the log has no localisation: give --mode joint"
        raise ConfigError("nothing to calibrate", where=str(path), hint=hint)
    result = pipeline.run(log, settings, ledger, show)
    if result.calibration is None:
        raise SolveError("nothing was calibrated", where=str(path), hint="; ".join(ledger.warnings) or None)
    return result.calibration.of_robot()


def _of_several(show: Progress, number: int, total: int) -> Progress:
    """Return a progress function that also names the current log, if there are several logs."""
    prefix = f"log {number} of {total}: " if total > 1 else ""
    show(f"{prefix}reading", 0, 0)
    return lambda stage, done, count: show(f"{prefix}{stage}", done, count)


def _check_target(out: Path, overwrite: bool) -> None:
    """Raise OutputError if the file cannot be written, or if it exists and `overwrite` is False."""
    from objslam.errors import OutputError

    if out.is_dir() or not out.absolute().parent.is_dir():
        what = "this is a folder" if out.is_dir() else "its folder does not exist"
        raise OutputError(f"cannot write: {what}", where=str(out), hint="name a file with -o")
    if out.exists() and not overwrite:
        raise OutputError("there is a file already", where=str(out), hint="name another one with -o, or give --overwrite")
