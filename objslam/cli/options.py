"""The options shared by several commands, and the conversion of the sources' options to flags."""

from __future__ import annotations

import difflib
import functools
import inspect
from collections.abc import Callable
from pathlib import Path
from types import GenericAlias
from typing import TYPE_CHECKING, Annotated, Any, Literal, get_args

import typer

from objslam.sources.options import DETECTOR, NAMES, Option, flags

if TYPE_CHECKING:
    from objslam.config import Settings


def one_of(*choices: str) -> Callable[[str], str]:
    """Return a parser for an option with few values. A wrong value is a usage error that names the closest value."""

    def parse(given: str) -> str:
        if given in choices:
            return given
        meant = difflib.get_close_matches(given, choices, 1)
        question = f" (did you mean {meant[0]}?)" if meant else ""
        raise typer.BadParameter(f"{given!r} is none of {', '.join(choices)}{question}")

    return parse


Out = Annotated[Path, typer.Option("-o", "--out", help="Folder for the result.")]
Config = Annotated[
    Path | None, typer.Option("--config", help="YAML file with settings, or the name of ready settings, such as odometry.")
]
Set = Annotated[list[str] | None, typer.Option("--set", metavar="KEY=VALUE", help="Change one setting. May be repeated.")]
Mode = Annotated[
    Literal["auto", "fixed", "joint"] | None,
    typer.Option(
        "--mode",
        parser=one_of("auto", "fixed", "joint"),
        metavar="[auto|fixed|joint]",
        help="fixed: keep the poses. joint: estimate poses and objects together. auto (the default): fixed for a log with a "
        "localisation, else joint.",
    ),
]
PriorMapPath = Annotated[
    Path | None,
    typer.Option(
        "--map",
        metavar="MAP",
        help="The map of another day: an objects.json, or a result folder. If the drive is found in this map, the result is "
        "in the frame of this map.",
    ),
]
Align = Annotated[
    Literal["auto", "none", "se2", "sim2", "se3", "sim3"],
    typer.Option(
        "--align",
        parser=one_of("auto", "none", "se2", "sim2", "se3", "sim3"),
        metavar="[auto|none|se2|sim2|se3|sim3]",
        help="Align the map with the truth. se2, se3: a rigid motion in the plane or in space. sim2, sim3: also a scale. "
        "auto: none if a localisation fixed the map's frame, else se2, or se3 if the path is not planar.",
    ),
]
Radius = Annotated[
    float, typer.Option("--radius", min=0.0, help="Maximum distance in m between a map object and its match in the truth.")
]
DetectorModel = Annotated[Path | None, typer.Option(DETECTOR.flag, help=DETECTOR.help)]
ClassNames = Annotated[str | None, typer.Option(NAMES.flag, metavar=NAMES.metavar, help=NAMES.help)]
EncoderModel = Annotated[
    Path | None,
    typer.Option(
        "--embed",
        metavar="MODEL",
        help="ONNX image encoder. It makes an appearance vector for each box from the rgb image of the box.",
    ),
]
Quiet = Annotated[bool, typer.Option("-q", "--quiet", help="Print warnings and errors only.")]
Json = Annotated[bool, typer.Option("--json", help="Print JSON for programs in place of text.")]
CalibrationFile = Annotated[
    Path | None, typer.Option("--calibration", help="The file that `objslam calibrate` wrote for this robot.")
]


def settings_of(
    mode: str | None,
    config: Path | None,
    set_: list[str] | None,
    calibration: Path | None = None,
    names: str | None = None,
) -> Settings:
    """Load the settings from --config, --set, --calibration, --names and --mode. --set overrides the other options, and all
    of them override --config. The files of --calibration and --names are checked, so that a wrong file fails before a long
    log is read."""
    import yaml

    from objslam.config import load_settings
    from objslam.config.presets import find_config

    more: tuple[str, ...] = ()
    if calibration is not None:
        more += (f"calibration.file={yaml.safe_dump(str(calibration.resolve()))}",)
    if names is not None:
        from objslam.frontend.class_names import KNOWN, load_names

        load_names(names)
        more += (f"detector.names={yaml.safe_dump(names if names in KNOWN else str(Path(names).resolve()))}",)
    settings = load_settings(
        None if config is None else find_config(config), ((f"mode={mode}",) if mode else ()) + more + tuple(set_ or ())
    )
    if settings.calibration.file is not None:
        from objslam.io.calibration_yaml import load_calibration

        load_calibration(Path(settings.calibration.file))
    return settings


def with_options(command: Callable[..., None]) -> Callable[..., None]:
    """Return the command with flags in place of its parameter `options`. In the class of `options`, each field with an
    `Option` becomes one flag."""
    signature = inspect.signature(command, eval_str=True)
    kind = signature.parameters["options"].annotation
    declared = flags(kind)

    @functools.wraps(command)
    def call(**given: Any) -> None:
        values: dict[str, Any] = {}
        for name, (_, option) in declared.items():
            value, default = given.pop(name), getattr(kind, name)
            if isinstance(default, tuple):
                values[name] = tuple(value or ())
            else:
                values[name] = not value if _is_negated(option, default) else value
        command(**given, options=kind(**values))

    parameters: list[inspect.Parameter] = []
    for parameter in signature.parameters.values():
        if parameter.name == "options":
            parameters += [
                _parameter(name, type_, option, getattr(kind, name)) for name, (type_, option) in declared.items()
            ]
        else:
            parameters.append(parameter)
    vars(call)["__signature__"] = signature.replace(parameters=parameters)
    return call


def _parameter(name: str, type_: Any, option: Option, default: Any) -> inspect.Parameter:
    """Return the typer parameter for an option that has the value `default` if it is not given."""
    if isinstance(default, tuple):  # typer repeats an option only if its type is a list
        type_, default = GenericAlias(list, get_args(type_)[0]) | None, None
    elif _is_negated(option, default):
        default = False
    declared = typer.Option(default, option.flag, help=option.help, metavar=option.metavar)
    return inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, default=declared, annotation=type_)


def _is_negated(option: Option, default: Any) -> bool:
    """Return whether the flag turns an option off that is on by default, as --without-range does."""
    return default is True and "/" not in option.flag
