"""Options that several commands take."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

if TYPE_CHECKING:
    from objslam.config import Settings
    from objslam.sources import SourceOptions

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
Format = Annotated[str | None, typer.Option("--format", help="What the recording is; guessed if not given.")]
Robot = Annotated[int | None, typer.Option("--robot", help="MRCLAM: which robot.")]
WithoutRange = Annotated[bool, typer.Option("--without-range", help="MRCLAM: bearings only.")]
Anonymous = Annotated[bool, typer.Option("--anonymous", help="MRCLAM: every landmark gets the same label.")]
DetectorModel = Annotated[
    Path | None,
    typer.Option("--detector", help="ONNX model that finds the boxes in the rgb images, in place of those of the log."),
]
Label = Annotated[str | None, typer.Option("--label", help="Label for boxes that come without one.")]
Topics = Annotated[
    list[str] | None,
    typer.Option(
        "--topic",
        metavar="ROLE=/NAME",
        help="ROS bags, dds, rclpy: the topic for a role (odometry, localization, detections, image, depth, camera_info; "
        "with several cameras CAMERA.ROLE=/NAME). none: no topic. tf: the path from the transforms. May be repeated.",
    ),
]
CameraInfo = Annotated[
    Path | None,
    typer.Option(
        "--camera-info", help="ROS bags, dds, rclpy: calibration, as in camera.yaml; several cameras below `cameras:`."
    ),
]
BaseFrame = Annotated[
    str | None, typer.Option("--base-frame", help="ROS bags, dds, rclpy: the frame that is the robot's base.")
]
Rectified = Annotated[
    bool | None,
    typer.Option(
        "--rectified/--raw",
        help="ROS bags, dds, rclpy: images and boxes are those of the rectified image, or not. [default: by name]",
    ),
]


def settings_of(mode: str | None, config: Path | None, set_: list[str] | None) -> Settings:
    """The settings that --mode, --config and --set ask for, the last the strongest."""
    from objslam.config import load_settings

    return load_settings(config, ((f"mode={mode}",) if mode else ()) + tuple(set_ or ()))


def source_options(
    format_: str | None,
    robot: int | None,
    without_range: bool,
    anonymous: bool,
    label: str | None,
    topics: list[str] | None,
    camera_info: Path | None,
    base_frame: str | None,
    rectified: bool | None,
) -> SourceOptions:
    """What the options of a command say of a recording."""
    from objslam.sources import SourceOptions

    return SourceOptions(
        format=format_,
        robot=robot,
        with_range=not without_range,
        anonymous=anonymous,
        label=label,
        topics=tuple(topics or ()),
        base_frame=base_frame,
        camera_info=camera_info,
        rectified=rectified,
    )
