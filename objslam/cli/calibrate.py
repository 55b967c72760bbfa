"""The command `objslam calibrate`, which estimates the shared errors of a robot from one or several logs."""

from pathlib import Path
from typing import Annotated

import typer

from objslam.cli.console import console, progress_bar, report, say
from objslam.cli.options import Config, Set, settings_of, with_options
from objslam.sources import SourceOptions


@with_options
def calibrate(
    logs: Annotated[list[Path], typer.Argument(metavar="LOG...", help="Logs of one robot, as for `objslam run`.")],
    out: Annotated[Path, typer.Option("-o", "--out", help="The calibration file to write.")] = Path("calibration.yaml"),
    config: Config = None,
    set_: Set = None,
    *,
    options: SourceOptions,
) -> None:
    """Estimate the errors that all measurements of a robot share, for `objslam run --calibration FILE`."""
    from objslam.cli.run import calibration_table
    from objslam.core.calibration import combine
    from objslam.core.diagnostics import Ledger
    from objslam.errors import ConfigError
    from objslam.io.atomic_files import write_file
    from objslam.io.calibration_yaml import dump_calibration
    from objslam.mapping import pipeline
    from objslam.sources import read

    settings = settings_of("joint", config, ["output.recording=false", *(set_ or ())])
    found = []
    with progress_bar() as show:
        for log in logs:
            ledger = Ledger()
            result = pipeline.run(read(log, ledger, options), settings, ledger, show)
            report(ledger)
            if result.calibration is None:
                raise ConfigError("nothing to calibrate", where=str(log), hint="the log needs odometry, and calibration.use")
            found.append(result.calibration)
    together = combine(found)
    console().print(calibration_table(together.to_dict()))
    write_file(out, dump_calibration(together).encode())
    say(f"wrote {out}, from {len(logs)} log{'' if len(logs) == 1 else 's'}")
