"""Options that several commands take. Those of the sources are declared with the sources, and come in by `with_options`."""

from __future__ import annotations

import functools
import inspect
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from types import GenericAlias
from typing import TYPE_CHECKING, Annotated, Any, Literal, get_args

import typer

from objslam.sources.options import DETECTOR, Option, flags

if TYPE_CHECKING:
    from objslam.config import Settings

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
DetectorModel = Annotated[Path | None, typer.Option(DETECTOR.flag, help=DETECTOR.help)]


def settings_of(mode: str | None, config: Path | None, set_: list[str] | None) -> Settings:
    """The settings that --mode, --config and --set ask for, the last the strongest."""
    from objslam.config import load_settings

    return load_settings(config, ((f"mode={mode}",) if mode else ()) + tuple(set_ or ()))


def with_options(command: Callable[..., None]) -> Callable[..., None]:
    """Spread the parameter `options` of a command, a class of options, into a flag for each field that has an `Option`."""
    signature = inspect.signature(command, eval_str=True)
    kind = signature.parameters["options"].annotation
    declared = [_Flag(name, type_, option, getattr(kind, name)) for name, (type_, option) in flags(kind).items()]

    @functools.wraps(command)
    def call(**given: Any) -> None:
        said = {flag.name: flag.value(given.pop(flag.name)) for flag in declared}
        command(**given, options=kind(**said))

    parameters: list[inspect.Parameter] = []
    for parameter in signature.parameters.values():
        parameters += [flag.parameter() for flag in declared] if parameter.name == "options" else [parameter]
    vars(call)["__signature__"] = signature.replace(parameters=parameters)
    return call


@dataclass(frozen=True)
class _Flag:
    """A field of a class of options as a parameter that typer understands, and the value that it stands for."""

    name: str
    type: Any
    option: Option
    default: Any

    def parameter(self) -> inspect.Parameter:
        annotation, default = self.type, False if self._says_no() else self.default
        if isinstance(default, tuple):  # typer repeats lists alone
            annotation, default = GenericAlias(list, get_args(annotation)[0]) | None, None
        said = typer.Option(default, self.option.flag, help=self.option.help, metavar=self.option.metavar)
        return inspect.Parameter(self.name, inspect.Parameter.KEYWORD_ONLY, default=said, annotation=annotation)

    def value(self, given: Any) -> Any:
        if isinstance(self.default, tuple):
            return tuple(given or ())
        return not given if self._says_no() else given

    def _says_no(self) -> bool:
        return self.default is True and "/" not in self.option.flag
