"""The command line. Heavy imports happen inside the commands: --help must answer at once."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal, NoReturn

import typer

from objslam.errors import ObjslamError

if TYPE_CHECKING:
    from rich.console import Console
    from rich.table import Table

    from objslam.config import Settings
    from objslam.ledger import Ledger
    from objslam.matching import Alignment
    from objslam.types import Log, ObjectMap

app = typer.Typer(
    name="objslam",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    help="A robot's log becomes a map of objects in 3D: poses and detector boxes in, positions with covariances out.",
)
config_app = typer.Typer(no_args_is_help=True, help="Look at the settings.")
app.add_typer(config_app, name="config")

Out = Annotated[Path, typer.Option("-o", "--out", help="Folder for the result.")]
Config = Annotated[Path | None, typer.Option("--config", help="YAML file with settings.")]
Set = Annotated[list[str] | None, typer.Option("--set", metavar="KEY=VALUE", help="Change one setting; may be repeated.")]
Mode = Annotated[
    Literal["fixed", "joint"] | None,
    typer.Option("--mode", help="fixed: the poses as they are. joint: poses and objects together. [default: fixed]"),
]
Align = Annotated[
    Literal["none", "se2", "sim2"],
    typer.Option("--align", help="Move the map onto the truth first: not at all, rigidly in the plane, or with a scale."),
]
Radius = Annotated[
    float, typer.Option("--radius", min=0.0, help="An object within this many metres of the truth matches it.")
]
Format = Annotated[str | None, typer.Option("--format", help="What SRC is; guessed from the folder if not given.")]
Robot = Annotated[int | None, typer.Option("--robot", help="MRCLAM: which robot.")]
WithoutRange = Annotated[bool, typer.Option("--without-range", help="MRCLAM: bearings only.")]
Anonymous = Annotated[bool, typer.Option("--anonymous", help="MRCLAM: every landmark gets the same label.")]
DetectorModel = Annotated[
    Path | None,
    typer.Option("--detector", help="ONNX model that finds the boxes in the rgb images, in place of those of the log."),
]
Label = Annotated[str | None, typer.Option("--label", help="Label for boxes that come without one.")]


def _version(asked: bool) -> None:
    if asked:
        from objslam import __version__

        _say(f"objslam {__version__}")
        raise typer.Exit


@app.callback()
def _options(
    debug: Annotated[bool, typer.Option("--debug", help="Show the traceback of an error.")] = False,
    version: Annotated[
        bool, typer.Option("--version", help="Print the version and exit.", callback=_version, is_eager=True)
    ] = False,
) -> None:
    pass


@app.command()
def run(
    log: Annotated[Path, typer.Argument(help="A log folder, or anything that `objslam convert` reads.")],
    out: Out = Path("out"),
    mode: Mode = None,
    config: Config = None,
    set_: Set = None,
    format_: Format = None,
    robot: Robot = None,
    without_range: WithoutRange = False,
    anonymous: Anonymous = False,
    label: Label = None,
    detector: DetectorModel = None,
) -> None:
    """Map the objects of a log and write the result to a folder."""
    from objslam.ledger import Ledger
    from objslam.results import prepare_output

    settings = _settings(mode, config, set_)
    ledger = Ledger()
    prepare_output(out)
    read = _read(log, ledger, format_, robot, without_range, anonymous, label)
    _run(read, settings, ledger, out, detector)


@app.command(name="eval")
def evaluate_result(
    out: Annotated[Path, typer.Argument(help="A result folder.")],
    truth: Annotated[
        Path | None,
        typer.Option("--truth", help="objects.json, or a groundtruth or log folder; what the log brought if not given."),
    ] = None,
    align: Align = "none",
    radius: Radius = 0.5,
) -> None:
    """Compare a result with ground truth: matched, missed and false objects, position errors, path error."""
    _evaluate(out, truth, align, radius)


@app.command()
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
    from objslam.ledger import Ledger
    from objslam.results import prepare_output
    from objslam.simulation import preset, simulate
    from objslam.sources.folder import read_log_folder, write_log_folder

    prepare_output(out)
    log, model = out / "log", None
    if boxes:
        write_log_folder(simulate(preset("demo"), seed), log, overwrite=True)
    else:
        from objslam.simulation.rendered import RenderSettings, render_drive

        model = Path(__file__).parent / "models" / "ssd7.onnx"
        with _progress() as show:
            render_drive(
                RenderSettings(), seed, log, overwrite=True, progress=lambda done, total: show("rendering", done, total)
            )
    _say(f"made a drive: {log}")
    for mode, poses in (("fixed", "localization"), ("joint", "odometry")):
        ledger = Ledger()
        # the shipped detector's box centres are off by 0.9 px in the median
        changes = [f"poses.use={poses}", *(["rays.pixel_sigma=1.5"] if model else [])]
        settings = _settings(mode, None, changes)
        shown = " ".join(["objslam run", str(log), "-o", str(out / mode), "--mode", mode, *(f"--set {c}" for c in changes)])
        _say(f"\n[bold]{shown}{f' --detector {model}' if model else ''}[/]", markup=True)
        _run(read_log_folder(log, ledger), settings, ledger, out / mode, model)
        # a map from odometry alone begins where the odometry does: how it lies in the room is not its to say
        _evaluate(out / mode, None, "none" if poses == "localization" else "se2", 0.5)
    _say(f"\nlook at {out / 'joint' / 'map.png'}, or open the recording: rerun {out / 'joint' / 'recording.rrd'}")


@app.command()
def convert(
    source: Annotated[
        Path, typer.Argument(metavar="SRC", help="What to read: UTIAS MRCLAM, TUM RGB-D with boxes, a log folder.")
    ],
    log: Annotated[Path, typer.Argument(metavar="LOG", help="The log folder to write.")],
    format_: Format = None,
    robot: Robot = None,
    without_range: WithoutRange = False,
    anonymous: Anonymous = False,
    label: Label = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace a log folder that is there.")] = False,
) -> None:
    """Write a data set as a log folder."""
    from objslam.ledger import Ledger
    from objslam.sources.folder import write_log_folder

    ledger = Ledger()
    read = _read(source, ledger, format_, robot, without_range, anonymous, label)
    write_log_folder(read, log, overwrite=overwrite)
    _report(ledger)
    _say(f"wrote {log}")


@config_app.command("dump")
def config_dump(config: Config = None, set_: Set = None) -> None:
    """Print every setting as YAML: the defaults, changed by --config and --set."""
    from objslam.config import dump_settings, load_settings

    _say(dump_settings(load_settings(config, tuple(set_ or ()))), end="")


def _settings(mode: str | None, config: Path | None, set_: list[str] | None) -> Settings:
    from objslam.config import load_settings

    return load_settings(config, ((f"mode={mode}",) if mode else ()) + tuple(set_ or ()))


def _read(
    path: Path,
    ledger: Ledger,
    format_: str | None,
    robot: int | None,
    without_range: bool,
    anonymous: bool,
    label: str | None,
) -> Log:
    from objslam.sources import SourceOptions, read

    return read(path, ledger, SourceOptions(format_, robot, not without_range, anonymous, label))


def _run(log: Log, settings: Settings, ledger: Ledger, out: Path, detector: Path | None = None) -> None:
    import time

    from objslam import offline
    from objslam.results import write_result

    with _progress() as show:
        if detector is not None:
            from objslam.detection import default_cache, detect_log, load_detector

            network = load_detector(detector, settings.detector)
            log = detect_log(log, network, settings, ledger, cache=default_cache(), progress=show)
        result = offline.run(log, settings, ledger, show)
        show("writing", 0, 0)
        begin = time.perf_counter()
        write_result(result, out, log.truth, detected=log.cameras if detector is not None else ())
        writing = time.perf_counter() - begin
    _report(ledger)
    counts, seconds = result.summary["counts"], {**result.summary["seconds"], "write": writing}
    _console().print(_objects_table(result.map))
    _say(
        f"{counts['objects'] - counts['unresolved']} objects ({counts['unresolved']} unresolved) from {counts['rays']} rays "
        f"in {counts['keyframes']} keyframes, {settings.mode} mode; "
        + ", ".join(f"{name} {value:.2f} s" for name, value in seconds.items())
    )
    _say(f"wrote {out}")


@contextmanager
def _progress() -> Iterator[Callable[[str, int, int], None]]:
    """A progress bar on stderr, where that is a terminal: called with the stage's name, what is done and the total."""
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, SpinnerColumn, TextColumn, TimeElapsedColumn

    columns = (SpinnerColumn(), TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    console = _console(stderr=True)
    with Progress(*columns, console=console, transient=True, disable=not console.is_terminal) as bar:
        task = bar.add_task("reading")
        yield lambda stage, done, total: bar.update(task, description=stage, completed=done, total=total or None)


def _evaluate(out: Path, truth: Path | None, align: Alignment, radius: float) -> None:
    from objslam.evaluation import evaluate, write_evaluation
    from objslam.evaluation_table import evaluation_table
    from objslam.results import load_map, load_trajectory, load_truth

    evaluation = evaluate(load_map(out), load_truth(truth or out), load_trajectory(out), align=align, radius=radius)
    write_evaluation(evaluation, out)
    _console().print(evaluation_table(evaluation))


def _objects_table(objects: ObjectMap) -> Table:
    import numpy as np
    from rich.table import Table

    table = Table(title="objects")
    for name in ("id", "label", "x m", "y m", "z m", "sigma m", "rays", "parallax deg", "rms deg", "status"):
        table.add_column(name, justify="left" if name in ("label", "status") else "right")
    for o in objects.objects:
        sigma = "" if o.covariance is None else f"{np.sqrt(np.linalg.eigvalsh(o.covariance)[-1]):.3f}"
        place = (f"{x:.3f}" for x in o.position)
        numbers = (str(o.rays), f"{o.parallax_deg:.1f}", f"{o.rms_deg:.2f}")
        table.add_row(str(o.id), o.label, *place, sigma, *numbers, o.status, style="dim" if o.status != "ok" else "")
    return table


def _report(ledger: Ledger) -> None:
    for line in ledger.lines():
        _say(f"warning: {line}", stderr=True)


def _console(stderr: bool = False) -> Console:
    from rich.console import Console

    return Console(stderr=stderr, highlight=False, width=None if sys.stdout.isatty() else 120)


def _say(text: str, *, stderr: bool = False, markup: bool = False, end: str = "\n") -> None:
    _console(stderr).print(text, markup=markup, end=end, soft_wrap=True)


def main() -> NoReturn:
    """Entry point: exit code 0 done, 1 the work failed (one line on stderr), 2 wrong use; a traceback with --debug only."""
    debug = "--debug" in sys.argv
    try:
        app()
    except ObjslamError as error:
        if debug:
            raise
        _say(f"objslam: {error}", stderr=True)
        sys.exit(error.exit_code)
    except KeyboardInterrupt:
        _say("objslam: interrupted", stderr=True)
        sys.exit(130)
    except MemoryError:
        _say("objslam: out of memory", stderr=True)
        sys.exit(1)
    except Exception as error:  # the last resort: no traceback reaches a user
        if debug:
            raise
        _say(
            f"objslam: internal error, {type(error).__name__}: {error} (please report it; objslam --debug shows where)",
            stderr=True,
        )
        sys.exit(1)
    sys.exit(0)
