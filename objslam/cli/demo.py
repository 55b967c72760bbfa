"""The command `objslam demo`, which simulates a drive, maps it, and evaluates the map."""

from functools import partial
from pathlib import Path
from typing import Annotated

import typer

import objslam
from objslam.cli.console import SpeakingLedger, progress_bar, put, say
from objslam.cli.evaluate import print_evaluation
from objslam.cli.options import settings_of
from objslam.cli.run import run_log


def demo(
    out: Annotated[
        Path | None,
        typer.Option("-o", "--out", help="Folder for log and results. Default: demo_out, or demo_boxes with --boxes."),
    ] = None,
    seed: Annotated[int, typer.Option("--seed", min=0, help="Seed of the random room and drive.")] = 0,
    boxes: Annotated[
        bool, typer.Option("--boxes", help="Simulate detector boxes without rendering images. This takes only seconds.")
    ] = False,
) -> None:
    """Simulate a drive. Map it once with fixed poses and once with joint estimation. Compare both maps with the truth.

    The drive is rendered as RGB-D images of a room with seven objects, which the detector shipped with objslam knows.
    """
    from objslam.errors import OutputError
    from objslam.output.result_folder import prepare_output, refuse_session
    from objslam.simulation import preset, simulate
    from objslam.sources import read
    from objslam.sources.log_folder import write_log_folder

    out = out or Path("demo_boxes" if boxes else "demo_out")
    refuse_session(out)
    prepare_output(out)
    log, model = out / "log", None
    mark = out / ".objslam-demo"  # This file marks a log that the demo may replace.
    if log.exists() and not mark.exists():
        raise OutputError(
            "this log is not from a demo and is not replaced", where=str(log), hint="choose another folder with -o"
        )
    mark.touch()
    if boxes:
        write_log_folder(simulate(preset("demo"), seed), log, overwrite=True)
    else:
        from objslam.simulation.render import RenderSettings, render_drive

        model = Path(objslam.__file__).parent / "detection" / "models" / "ssd7.onnx"
        with progress_bar() as show:
            render_drive(RenderSettings(), seed, log, overwrite=True, progress=partial(show, "rendering"))
    say(f"wrote the simulated drive: {log}")
    for mode, poses in (("fixed", "localization"), ("joint", "odometry")):
        ledger = SpeakingLedger()
        # The default of 3 px is too large: the median error of the box centres of the shipped detector is 0.9 px.
        changes = [f"poses.use={poses}", *(["rays.pixel_sigma=1.5"] if model else [])]
        settings = settings_of(mode, None, changes)
        shown = " ".join(["objslam run", str(log), "-o", str(out / mode), "--mode", mode, *(f"--set {c}" for c in changes)])
        put(f"\n{shown}{f' --detector {model}' if model else ''}\n", style="bold")
        run_log(read(log, ledger), settings, ledger, out / mode, model)
        print_evaluation(out / mode, None, "auto", 0.5)
    say(f"\nopen {out / 'joint' / 'map.png'}, or run: objslam view {out / 'joint'}")
