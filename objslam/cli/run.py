"""The command `objslam run`, which maps the objects of a log and writes a result folder."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final

import typer

from objslam.cli.console import SpeakingLedger, console, progress_bar, put, report, say, warn_of_neighbours
from objslam.cli.options import (
    CalibrationFile,
    Config,
    DetectorModel,
    EncoderModel,
    Json,
    Mode,
    Out,
    PriorMapPath,
    Quiet,
    Set,
    settings_of,
    with_options,
)
from objslam.sources import SourceOptions, read

if TYPE_CHECKING:
    from rich.console import Console
    from rich.table import Table

    from objslam.config import Settings
    from objslam.config.tags import Tags
    from objslam.core.object_map import MapObject
    from objslam.core.result import RunResult
    from objslam.core.types import Log
    from objslam.mapping.localization import PriorMap

_COLUMNS: Final[dict[str, Callable[[MapObject], str]]] = {
    "id": lambda o: str(o.id),
    "label": lambda o: o.label,
    "x m": lambda o: _number(o.position[0], 3),
    "y m": lambda o: _number(o.position[1], 3),
    "z m": lambda o: _number(o.position[2], 3),
    "sigma m": lambda o: "" if o.sigma is None else f"{o.sigma:.3f}",
    "size m": lambda o: _size(o),
    "rays": lambda o: str(o.rays),
    "parallax deg": lambda o: f"{o.parallax_deg:.1f}",
    "rms deg": lambda o: _number(o.rms_deg, 2),
    "status": lambda o: o.status,
}
"""The columns of the table of objects, each with the text of its cells. A cell without a value is empty."""
_SPARE = ("parallax deg", "rms deg", "size m", "rays", "sigma m", "status")
"""The columns that a narrow terminal leaves out, in this order."""
_NOISE: Final = {
    "rays": "rays",
    "ranges": "ranges",
    "range_bias": "offset of the ranges",
    "along": "odometry along",
    "across": "odometry across",
    "turning": "odometry in turns",
    "heading": "heading of the poses",
    "place": "place of the poses",
}
"""The names of the noise factors in the output. A factor of 1 is not shown. It means that the log does not determine the
noise, or that the noise is as set."""
NOT_LOCALISED = 3
"""The exit code of a run that wrote its result, but whose drive was not found in the map of --map."""
_WIDE = 10_000  # A width that no table has, characters. In a console of this width, the full width of a table is measured.


@with_options
def run(
    log: Annotated[Path, typer.Argument(help="A log folder, a ROS bag, or another recording that `objslam info` reads.")],
    out: Out = Path("out"),
    mode: Mode = None,
    config: Config = None,
    set_: Set = None,
    *,
    options: SourceOptions,
    detector: DetectorModel = None,
    embed: EncoderModel = None,
    calibration: CalibrationFile = None,
    map_: PriorMapPath = None,
    quiet: Quiet = False,
    json: Json = False,
) -> None:
    """Map the objects of a log and write a result folder.

    With --map, the exit code is 3 if the drive is not found in that map.
    """
    from objslam.api.mapping import prior_map
    from objslam.output.result_folder import output_folder

    settings = settings_of(mode, config, set_, calibration, options.class_names)
    ledger = SpeakingLedger()
    with output_folder(out):
        warn_of_neighbours(out)
        tell = _say_nothing if quiet else _say_json if json else say_result
        known = None if map_ is None else prior_map(map_)
        with progress_bar(ledger, quiet=quiet):
            given = read(log, ledger, options)
        result = run_log(given, settings, ledger, out, detector, tell, known, embed)
    if known is not None and not result.summary["localisation"]["localised"]:
        raise typer.Exit(NOT_LOCALISED)


def run_log(
    log: Log,
    settings: Settings,
    ledger: SpeakingLedger,
    out: Path,
    detector: Path | None = None,
    tell: Callable[[RunResult, str, Path, tuple[str, ...]], None] | None = None,
    known: PriorMap | None = None,
    embed: Path | None = None,
) -> RunResult:
    """Map the objects of a log, write the result folder, and print a summary.

    detector: the ONNX detector whose boxes replace the boxes of the log. tell: the function that prints the summary, by
    default `say_result`. known: the map of another day, in which the run looks for the drive. embed: the ONNX encoder that
    makes the appearance vectors of the boxes.
    """
    import time

    from objslam.api.mapping import map_log
    from objslam.output.result_folder import write_result

    with progress_bar(ledger, quiet=tell is _say_nothing) as show:
        result, log = map_log(log, settings, ledger, detector, show, known, embed)
        show("writing", 0, 0)
        begin = time.perf_counter()
        made = detector is not None or embed is not None
        removed = write_result(result, out, log.truth, detected=log.cameras if made else ())
        seconds = {**result.summary["seconds"], "write": time.perf_counter() - begin}
    report(ledger)
    times = ", ".join(f"{name} {value:.2f} s" for name, value in seconds.items() if value >= 0.005)
    (tell or say_result)(result, f", {result.settings.mode} mode; {times}", out, removed)
    return result


def _say_nothing(result: RunResult, more: str, out: Path, removed: tuple[str, ...]) -> None:
    """Print nothing. With --quiet, this replaces `say_result`."""


def _say_json(result: RunResult, more: str, out: Path, removed: tuple[str, ...]) -> None:
    """Print the objects, the summary and the names of the files as JSON. With --json, this replaces `say_result`."""
    import json

    from objslam.io.objects_json import dump_objects
    from objslam.io.results.files import dump_json

    objects = json.loads(dump_objects(result.map))["objects"]
    put(dump_json({"out": str(out), "removed": removed, "objects": objects, "summary": result.summary}))


def say_result(result: RunResult, more: str, out: Path, removed: tuple[str, ...]) -> None:
    """Print the objects and the summary of a result. more: the text after the counts. out: the result folder. removed: the
    names of the files of an older result that were removed."""
    if result.map.objects:
        console().print(objects_table(result.map.objects, console()))
    if advice := advice_on_tags(result.map.objects, result.settings.tags):
        say(advice)
    if calibration := result.summary.get("calibration"):
        if any(of["observable"] for of in calibration["parameters"].values()):
            console().print(calibration_table(calibration))
        else:
            none = "this log shows none of them; the sigmas contain their usual sizes"
            say(f"errors that all measurements share: {none}")
    noise = result.summary.get("noise") or {}
    factors = {words: f"{noise.get(name, 1.0):.2g}" for name, words in _NOISE.items()}
    of = result.settings.localization
    for name, nominal, unit in (("heading", math.degrees(of.yaw), "deg"), ("place", 100 * of.xy, "cm")):
        if noise.get(f"{name}_share"):
            size = f"{noise[name] * nominal:.2g} {unit} for {noise[f'{name}_seconds']:.2g} s"
            factors[_NOISE[name]] += f" ({size})"
    if found := [f"{words} {factor}" for words, factor in factors.items() if factor != "1"]:
        say(f"noise found in the log (1 = as set): {', '.join(found)}")
    counts = result.summary["counts"]
    resolved = counts["objects"] - counts["unresolved"]
    lost = f" and {counts['unresolved']} unresolved" if counts["unresolved"] else ""
    say(
        f"{resolved} object{'' if resolved == 1 else 's'}{lost} from {counts['rays']} rays "
        f"({counts['rays_unexplained']} of no object) in {counts['keyframes']} keyframes{more}"
    )
    if told := result.summary.get("localisation"):
        say(told["line"])
    judged = result.summary["assessment"]
    say(" ".join([f"verdict: {judged['level']}.", *judged["reasons"]]))
    if removed:
        say(f"removed the older result from {out}: {', '.join(removed)}")
    say(f"wrote {out}")


def _number(value: float, digits: int) -> str:
    return f"{value:.{digits}f}" if math.isfinite(value) else ""


def _size(o: MapObject) -> str:
    """Return length, width and height of an object's body as text, m. Return the side of a fiducial, and "" for a point."""
    if o.tag is not None:
        return f"{o.tag.size:.3f}"
    return "" if o.body is None else " x ".join(f"{side:.2f}" for side in o.body.size)


def advice_on_tags(objects: Sequence[MapObject], given: Tags) -> str:
    """Return advice to the user if the sizes of fiducials are estimated. Return "" if there are no such fiducials."""
    if not any(o.tag is not None and given.size_of(o.label) is None for o in objects):
        return ""
    return "the sides of tags are estimated in the scale of the poses; a known side sets the scale: --set tags.size=METRES"


def objects_table(objects: Sequence[MapObject], screen: Console) -> Table:
    """Return a table of objects, sorted by label and id, without empty columns.

    Columns of `_SPARE` for which the screen has no room are left out, so that no number is cut.
    """
    from rich.measure import Measurement
    from rich.table import Table

    names = [name for name, text in _COLUMNS.items() if not objects or any(map(text, objects))]
    for spare in (None, *_SPARE):
        if spare in names:
            names.remove(spare)
        table = Table(title="objects")
        for name in names:
            words = name in ("label", "status")
            table.add_column(name, justify="left" if words else "right", overflow="fold")
        for o in sorted(objects, key=lambda o: (o.label, o.id)):
            table.add_row(*(_COLUMNS[name](o) for name in names), style="dim" if o.status != "ok" else "")
        if Measurement.get(screen, screen.options.update(max_width=_WIDE), table).maximum <= screen.width:
            break
    return table


def calibration_table(calibration: dict[str, Any]) -> Table:
    """Return a table of the shared errors. It marks the errors that the log does not determine."""
    from rich.table import Table

    pairs = "; ".join(" and ".join(pair) for pair in calibration["traded_off"])
    table = Table(
        title="errors that all measurements share", caption=f"this log cannot tell apart: {pairs}" if pairs else None
    )
    for name in ("error", "found", "sigma", "prior sigma", "unit", "known from"):
        words = name in ("error", "unit", "known from")
        table.add_column(name, justify="left" if words else "right", no_wrap=True)
    for name, of in calibration["parameters"].items():
        numbers = (f"{of[key]:.4f}" for key in ("value", "sigma", "prior_sigma"))
        source = "the log" if of["observable"] else "the prior"
        table.add_row(name, *numbers, of["unit"], source, style="" if of["observable"] else "dim")
    return table
