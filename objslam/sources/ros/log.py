"""ROS bags read into a log."""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from objslam.errors import LogError
from objslam.ledger import Ledger
from objslam.sources.box_depths import depths_at_boxes
from objslam.sources.camera_file import Calibration, read_calibrations
from objslam.sources.ros.boxes2d import boxes_of_points
from objslam.sources.ros.cameras import CameraTopics, build_camera, find_cameras
from objslam.sources.ros.images import DEPTH_SCALE, extract_images
from objslam.sources.ros.paths import Paths, read_paths
from objslam.sources.ros.recording import find_recording
from objslam.sources.ros.roles import parse_choices
from objslam.sources.ros.survey import Survey, Topic, is_tags, take_survey
from objslam.sources.ros.tf_tree import TfTree
from objslam.types import Camera, CameraLog, Detections, Images, Log, Trajectory

_KEPT: list[tempfile.TemporaryDirectory[str]] = []
"""Folders of images that nobody named a place for: removed when the program ends."""


@dataclass(frozen=True)
class BagOptions:
    """What a recording does not say itself.

    topics: choices "role=/topic" or "camera.role=/topic"; "none" for no topic, "tf" for the transforms. base_frame: the
    frame that is base. camera_info: a calibration file (camera.yaml, or several of them below `cameras:`). rectified:
    whether boxes are in the pixels of the rectified image, None to tell by the topics' names. extract: the folder that
    images go to; None: a temporary one, which is there until the program ends. with_images: whether they are read at all.
    with_range: whether depth images give the boxes their depth. label: for boxes without a class.
    """

    topics: tuple[str, ...] = ()
    base_frame: str | None = None
    camera_info: Path | None = None
    rectified: bool | None = None
    extract: Path | None = None
    with_images: bool = True
    with_range: bool = True
    label: str | None = None


@dataclass(frozen=True)
class Assembly:
    """A recording with all roles cast.

    cast: the topics of every camera. cameras: those that could be put together as (topics, camera, mount). problems: why a
    run cannot be; left_out: why some of the cameras are not in it.
    """

    survey: Survey
    tree: TfTree
    paths: Paths | None
    cast: tuple[CameraTopics, ...]
    cameras: tuple[tuple[CameraTopics, Camera, Trajectory | None], ...]
    problems: tuple[LogError, ...]
    left_out: tuple[LogError, ...]


def read_bag(paths: Path | Sequence[Path], ledger: Ledger, options: BagOptions | None = None) -> Log:
    """Read a ROS 1 bag, a ROS 2 bag (sqlite3 or MCAP; file or folder), or several files of one recording.

    The recording is read once for everything but images, and a second time for those. Stamps are those of the headers.
    Damaged files are read as far as they can be, with what is lost in the ledger; they are never changed. LogError where
    a path of the robot or every camera is missing, with what was found; ConfigError for options that do not fit.
    """
    options = options or BagOptions()
    assembly = assemble(paths, ledger, options)
    report_damage(assembly.survey, ledger)
    if assembly.problems:
        first = assembly.problems[0]
        damage = [line for report in assembly.survey.reports for line in report.lines()]
        raise LogError(first.message, where=first.where, hint="; ".join(filter(None, [first.hint, *damage])))
    for error in assembly.left_out:
        ledger.warn(f"{error}: left out")
    images = _extract(assembly, options, ledger) if options.with_images else {}
    assert assembly.paths is not None  # its absence is a problem
    return Log(
        name=assembly.survey.recording.name,
        cameras=tuple(_camera_log(*camera, images, options, ledger) for camera in assembly.cameras),
        odometry=assembly.paths.odometry,
        localization=assembly.paths.localization,
    )


def assemble(paths: Path | Sequence[Path], ledger: Ledger, options: BagOptions) -> Assembly:
    """Read all but the images of a recording and cast the roles; LogError where no file of it can be read."""
    calibrations: tuple[Calibration, ...] = ()
    if options.camera_info is not None:
        calibrations = read_calibrations(options.camera_info, ledger)
    recording = find_recording(paths, ledger)
    survey = take_survey(recording, label=options.label or "")
    choices = parse_choices(options.topics, survey)
    for topic in survey.topics.values():
        for reason, count in topic.refused.items():
            ledger.drop(f"message that cannot be used: {reason}", count, topic.name)
    tree = TfTree(survey.tf, ledger)
    problems: list[LogError] = []
    found: Paths | None = None
    try:
        found = read_paths(survey, tree, choices, options.base_frame, ledger)
    except LogError as error:
        problems.append(error)
    base = found.base if found is not None else options.base_frame or ""
    cameras, refused = [], []
    cast = find_cameras(survey, tree, choices, calibrations, options.rectified, ledger)
    for topics in cast:
        try:
            cameras.append((topics, *build_camera(topics, tree, base, ledger)))
        except LogError as error:
            refused.append(error)
    if not cameras:
        problems += refused or [_no_camera(survey)]
    return Assembly(survey, tree, found, cast, tuple(cameras), tuple(problems), tuple(refused if cameras else ()))


def report_damage(survey: Survey, ledger: Ledger) -> None:
    """Put what was lost of the files into the ledger."""
    for report in survey.reports:
        ledger.drop("message lost in a damaged bag", report.lost, report.file)
        for line in report.lines():
            ledger.warn(line)


def _no_camera(survey: Survey) -> LogError:
    types = {topic.type for topic in survey.topics.values()}
    images = any(name.endswith(("/Image", "/CompressedImage")) for name in types)
    what = "images, but none with a CameraInfo" if images else "no images and no detections"
    hint = "vision_msgs/Detection2DArray, AprilTag detections, or images with CameraInfo (or --camera-info FILE) are needed"
    return LogError(f"no camera: the recording has {what}", where=survey.recording.name, hint=hint)


def _extract(assembly: Assembly, options: BagOptions, ledger: Ledger) -> dict[str, Images]:
    wanted: dict[str, tuple[str, bool]] = {}
    for topics, _, _ in assembly.cameras:
        for topic, kind in ((topics.image, "rgb"), (topics.depth, "depth")):
            if topic is not None:
                wanted.setdefault(topic.name, (f"{_folder_name(topics.name)}/{kind}", kind == "depth"))
    if not wanted:
        return {}
    folder = options.extract
    if folder is None:
        _KEPT.append(tempfile.TemporaryDirectory(prefix="objslam_images_"))
        folder = Path(_KEPT[-1].name)
    return extract_images(
        assembly.survey.recording, {name: (folder / place, depth) for name, (place, depth) in wanted.items()}, ledger
    )


def _folder_name(camera: str) -> str:
    return "".join(c if c.isalnum() or c in "_-" else "_" for c in camera)


def _camera_log(
    topics: CameraTopics,
    camera: Camera,
    mount: Trajectory | None,
    images: dict[str, Images],
    options: BagOptions,
    ledger: Ledger,
) -> CameraLog:
    camera = replace(camera, depth_scale=DEPTH_SCALE)
    rgb = images.get(topics.image.name) if topics.image is not None else None
    depth = images.get(topics.depth.name) if topics.depth is not None else None
    detections = _detections(topics.detections, camera, ledger) if topics.detections is not None else None
    if detections is not None and depth is not None and options.with_range:
        detections = depths_at_boxes(detections, depth, camera, ledger)
    return CameraLog(camera, detections, rgb, depth, mount)


def _detections(topic: Topic, camera: Camera, ledger: Ledger) -> Detections:
    boxes = replace(topic.boxes, stamps=(topic.times() / 1e9).tolist(), boxes=list(topic.boxes.boxes))
    if topic.points:
        projected = boxes_of_points(camera, np.array(list(topic.points.values())))
        for index, box in zip(topic.points, projected.tolist(), strict=True):
            boxes.boxes[index] = box
    return replace(boxes.checked(ledger), whole=is_tags(topic.type))
