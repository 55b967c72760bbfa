"""ROS bags read into a log."""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from objslam.core.camera import Camera
from objslam.core.diagnostics import Ledger
from objslam.core.types import CameraLog, Detections, Images, Log, Trajectory
from objslam.errors import LogError
from objslam.frontend.box_depths import depths_at_boxes
from objslam.io.camera_yaml import Calibration, read_calibrations
from objslam.ros.bag.recording import find_recording
from objslam.ros.messages.detections import boxes_of_points
from objslam.ros.messages.images import DEPTH_SCALE
from objslam.ros.messages.topic_types import is_tags
from objslam.ros.tf.tree import TfTree
from objslam.ros.topics import parse_topics
from objslam.sources.ros_bag.cameras import CameraTopics, build_camera, find_cameras
from objslam.sources.ros_bag.images import extract_images
from objslam.sources.ros_bag.options import BagOptions
from objslam.sources.ros_bag.survey import Survey, Topic, take_survey
from objslam.sources.ros_bag.topic_roles import TopicPool, check_choices
from objslam.sources.ros_bag.trajectories import Paths, read_paths

_KEPT: list[tempfile.TemporaryDirectory[str]] = []
"""Folders of images that nobody named a place for: removed when the program ends."""


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
    choices = parse_topics(options.topics)
    recording = find_recording(paths, ledger)
    survey = take_survey(recording, label=options.label or "")
    check_choices(choices, survey)
    for topic in survey.topics.values():
        for reason, count in topic.refused.items():
            ledger.drop(f"message that cannot be used: {reason}", count, topic.name)
    tree, pool = TfTree(survey.tf, ledger), TopicPool(survey, choices, ledger)
    problems: list[LogError] = []
    found: Paths | None = None
    try:
        found = read_paths(pool, tree, options.base_frame)
    except LogError as error:
        problems.append(error)
    base = found.base if found is not None else options.base_frame or ""
    cameras, refused = [], []
    cast = find_cameras(pool, tree, calibrations, options.rectified)
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
