"""objslam demo: make a drive, map it, compare it with the truth."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

import objslam
from objslam.cli.console import progress_bar, say
from objslam.cli.evaluate import print_evaluation
from objslam.cli.options import Out, settings_of
from objslam.cli.run import run_log


def demo(
    out: Out = Path("demo_out"),
    seed: Annotated[int, typer.Option("--seed", min=0, help="Another seed is another room and drive.")] = 0,
    boxes: Annotated[
        bool, typer.Option("--boxes", help="Simulate the detector's boxes too, without rendering images: done in seconds.")
    ] = False,
) -> None:
    """Make a drive, map it with the poses as they are and together with them, and compare both with the truth.

    The drive is rendered: a furnished room, RGB-D images, seven objects that the detector shipped with objslam knows.
    """
    from objslam.core.diagnostics import Ledger
    from objslam.errors import OutputError
    from objslam.output.result_folder import prepare_output
    from objslam.simulation import preset, simulate
    from objslam.sources import read
    from objslam.sources.log_folder import write_log_folder

    prepare_output(out)
    log, model = out / "log", None
    mark = out / ".objslam-demo"  # whoever finds it may replace the log
    if log.exists() and not mark.exists():
        raise OutputError("there is a log that no demo made", where=str(log), hint="name another folder with -o")
    mark.touch()
    if boxes:
        write_log_folder(simulate(preset("demo"), seed), log, overwrite=True)
    else:
        from objslam.simulation.render import RenderSettings, render_drive

        model = Path(objslam.__file__).parent / "models" / "ssd7.onnx"
        with progress_bar() as show:
            render_drive(
                RenderSettings(), seed, log, overwrite=True, progress=lambda done, total: show("rendering", done, total)
            )
    say(f"made a drive: {log}")
    for mode, poses in (("fixed", "localization"), ("joint", "odometry")):
        ledger = Ledger()
        # the shipped detector's box centres are off by 0.9 px in the median
        changes = [f"poses.use={poses}", *(["rays.pixel_sigma=1.5"] if model else [])]
        settings = settings_of(mode, None, changes)
        shown = " ".join(["objslam run", str(log), "-o", str(out / mode), "--mode", mode, *(f"--set {c}" for c in changes)])
        say(f"\n[bold]{shown}{f' --detector {model}' if model else ''}[/]", markup=True)
        run_log(read(log, ledger), settings, ledger, out / mode, model)
        # a map from odometry alone begins where the odometry does: how it lies in the room is not its to say
        print_evaluation(out / mode, None, "none" if poses == "localization" else "se2", 0.5)
    say(f"\nlook at {out / 'joint' / 'map.png'}, or open the recording: objslam view {out / 'joint'}")
