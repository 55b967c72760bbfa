"""Options that several commands take."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

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
Format = Annotated[str | None, typer.Option("--format", help="What SRC is; guessed from the folder if not given.")]
Robot = Annotated[int | None, typer.Option("--robot", help="MRCLAM: which robot.")]
WithoutRange = Annotated[bool, typer.Option("--without-range", help="MRCLAM: bearings only.")]
Anonymous = Annotated[bool, typer.Option("--anonymous", help="MRCLAM: every landmark gets the same label.")]
DetectorModel = Annotated[
    Path | None,
    typer.Option("--detector", help="ONNX model that finds the boxes in the rgb images, in place of those of the log."),
]
Label = Annotated[str | None, typer.Option("--label", help="Label for boxes that come without one.")]


def settings_of(mode: str | None, config: Path | None, set_: list[str] | None) -> Settings:
    """The settings that --mode, --config and --set ask for, the last the strongest."""
    from objslam.config import load_settings

    return load_settings(config, ((f"mode={mode}",) if mode else ()) + tuple(set_ or ()))
