"""Read a ROS bag into a `Log`."""

import re
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from itertools import compress
from pathlib import Path
from typing import Any

import numpy as np

from objslam.core.camera import Camera
from objslam.core.diagnostics import Ledger
from objslam.core.trajectory import Trajectory
from objslam.core.types import CameraLog, Images, Log
from objslam.errors import LogError
from objslam.frontend.box_depths import depths_at_boxes
from objslam.io.camera_yaml import read_calibrations, read_mounts
from objslam.io.text import count_drops, in_order
from objslam.ros.bag.recording import Recording, find_recording, read_messages
from objslam.ros.bag.records import Connection, FileReport
from objslam.ros.messages.decode import DecodeError, make_decoder, read_head
from objslam.ros.messages.detections import boxes_of_points
from objslam.ros.messages.images import DEPTH_SCALE, image_file
from objslam.ros.messages.topic_types import IMAGES, TRANSFORMS, is_read, is_tags
from objslam.ros.tf.frames import find_base
from objslam.ros.tf.tree import TfTree
from objslam.ros.topics import parse_topics
from objslam.sources.no_camera import NoCamera
from objslam.sources.ros_bag.cameras import CameraTopics, build_camera, find_cameras
from objslam.sources.ros_bag.options import BagOptions
from objslam.sources.ros_bag.places import camera_places
from objslam.sources.ros_bag.survey import Survey, take_survey
from objslam.sources.ros_bag.tf_topics import choose_robot
from objslam.sources.ros_bag.topic_roles import TopicPool, check_choices
from objslam.sources.ros_bag.trajectories import Paths, read_paths

_KEPT: list[tempfile.TemporaryDirectory[str]] = []
"""The temporary folders for the images of bags that are read without `extract`. They are removed when the program ends."""


_NO_INFO = "record CameraInfo too, or give --camera-info FILE"  # The advice for images without a CameraInfo.
_BOX_WORDS = ("detection", "boundingbox", "bounding_box")
"""Parts of the names of message types that contain boxes. With more words, the advice names more topics."""
_NO_BOXES = """boxes from a file: `objslam convert` makes a log of this bag, put detections.jsonl into it; or record \
Detection2DArray, AprilTag detections, or images with CameraInfo"""  # The advice for a bag without images and boxes.


@dataclass(frozen=True)
class Assembly:
    """A recording in which each topic has its role. A role is, for example, the odometry or the images of a camera.

    tree: the tree of tf. tf_topics: the names of the topics of tf. base: the base frame. paths: the robot's paths, None if
    there are none. cast: the topics of every camera. cameras: the topics, the camera and its mount, for each usable camera.
    The mount is base_T_camera over time, None if the camera does not move on the robot. problems: the errors that make a run
    impossible. left_out: the errors of the unusable cameras, if other cameras are usable.
    """

    survey: Survey
    tree: TfTree
    tf_topics: frozenset[str]
    base: str
    paths: Paths | None
    cast: tuple[CameraTopics, ...]
    cameras: tuple[tuple[CameraTopics, Camera, Trajectory | None], ...]
    problems: tuple[LogError, ...]
    left_out: tuple[LogError, ...]


def read_bag(paths: Path | Sequence[Path], ledger: Ledger, options: BagOptions | None = None) -> Log:
    """Return the log of a ROS 1 bag, a ROS 2 bag (sqlite3 or MCAP, file or folder), or several files of one recording.

    The first pass reads all messages and keeps everything except the images. The second pass reads the images, unless
    `options.with_images` is False. Stamps are from the headers. If the headers have no stamps, the times of recording are
    taken. Damaged files are read as far as possible and never changed. The ledger counts the lost messages. Raises LogError
    if the robot's path is missing or no camera is usable, and ConfigError for options that do not fit the bag. The LogError
    is a NoCamera if the bag has a path, but neither images nor detections.
    """
    options = options or BagOptions()
    assembly = assemble(paths, ledger, options)
    for report in assembly.survey.reports:
        ledger.drop("message lost in a damaged bag", report.lost, report.file)
        for line in report.lines():
            ledger.warn(line)
    if assembly.problems:
        first = assembly.problems[0]
        hint = "; ".join(filter(None, [first.hint, *assembly.survey.damage()]))
        if isinstance(first, NoCamera):
            for error in assembly.problems[1:]:
                ledger.warn(f"{error}: left out")
            raise first.with_hint(hint)
        raise LogError(first.message, where=first.where, hint=hint)
    for error in assembly.left_out:
        ledger.warn(f"{error}: left out")
    images = _extract(assembly, options, ledger) if options.with_images else {}
    assert assembly.paths is not None  # Without a path, `problems` is not empty.
    return Log(
        name=assembly.survey.recording.name,
        cameras=tuple(_camera_log(*camera, images, options, ledger) for camera in assembly.cameras),
        odometry=assembly.paths.odometry,
        localization=assembly.paths.localization,
    )


def assemble(paths: Path | Sequence[Path], ledger: Ledger, options: BagOptions) -> Assembly:
    """Return a recording without its images, with the role of each topic.

    Raises LogError if no file can be read, and ConfigError for options that do not fit the recording.
    """
    calibrations = () if options.camera_info is None else read_calibrations(options.camera_info, ledger)
    mounts = () if options.camera_info is None else read_mounts(options.camera_info)
    choices = parse_topics(options.topics)
    survey = take_survey(find_recording(paths, ledger), options.label or "")
    check_choices(choices, survey)
    for topic in survey.topics.values():
        for reason, count in topic.refused.items():
            ledger.drop(f"message that cannot be used: {reason}", count, topic.name)
    transforms, pool = choose_robot(TopicPool(survey, choices, ledger))
    tf_topics = frozenset(topic.name for topic in pool.survey.topics.values() if topic.type in TRANSFORMS)
    tree = TfTree(transforms, ledger)
    problems: list[LogError] = []
    found: Paths | None = None
    base = find_base(tree.frames, options.base_frame, "")
    try:
        found = read_paths(pool, tree, options.base_frame)
        base = found.base
    except LogError as error:
        problems.append(error)
    cameras, refused = [], []
    cast = find_cameras(pool, tree, calibrations, options.rectified)
    for topics in cast:
        try:
            cameras.append((topics, *build_camera(topics, tree, base, ledger, mounts)))
        except LogError as error:
            refused.append(error)
    if not any(topics.detections or topics.image for topics in cast):
        images = not cast and any(topic.type in IMAGES for topic in survey.topics.values())
        what = "images, but none with a CameraInfo" if images else "no images and no detections"
        message, where = f"no camera: the recording has {what}", survey.recording.name
        hint = unread_boxes(survey) or _NO_BOXES
        if found is None or images:
            problems.append(LogError(message, where=where, hint=_NO_INFO if images else hint))
        else:
            places = camera_places(tree, base)
            known = {place.frame: place.base_T_frame for place in places if place.base_T_frame is not None}
            logs = tuple(_camera_log(*camera, {}, options, ledger) for camera in cameras)
            problems.append(NoCamera(message, where, hint, found.odometry, found.localization, known, logs))
    if not cameras:
        problems += refused
    _warn_of_unset_stamps(survey, found, cast, ledger)
    return Assembly(
        survey, tree, tf_topics, base, found, cast, tuple(cameras), tuple(problems), tuple(refused if cameras else ())
    )


def unread_boxes(survey: Survey) -> str:
    """Return advice if topics probably have boxes in messages that objslam does not read. Return "" without such topics."""
    found = [
        f"{topic.name} has {topic.type}"
        for topic in survey.topics.values()
        if not is_read(topic.type) and any(word in topic.type.lower() for word in _BOX_WORDS)
    ]
    return f"{', '.join(found)}, which is not read: record vision_msgs/Detection2DArray, or {_NO_BOXES}" if found else ""


def _warn_of_unset_stamps(survey: Survey, paths: Paths | None, cast: Sequence[CameraTopics], ledger: Ledger) -> None:
    used = [survey.topics[name] for name in (paths.roles if paths else ())]
    used += [topic for topics in cast for topic in (topics.detections, topics.image, topics.depth) if topic is not None]
    for topic in used:
        if topic.stamps and not any(topic.stamps):
            ledger.warn(
                f"{topic.name}: all header stamps are zero. The times of recording are used instead, and the delay of each "
                "message makes them late"
            )


def _extract(assembly: Assembly, options: BagOptions, ledger: Ledger) -> dict[str, Images]:
    if not any(topics.image or topics.depth for topics, _, _ in assembly.cameras):
        return {}
    folder = options.extract
    if folder is None:
        _KEPT.append(tempfile.TemporaryDirectory(prefix="objslam_images_"))
        folder = Path(_KEPT[-1].name)
    folders: dict[str, tuple[Path, bool]] = {}
    for topics, _, _ in assembly.cameras:
        for topic, kind in ((topics.image, "rgb"), (topics.depth, "depth")):
            if topic is not None:
                folders.setdefault(topic.name, (folder / re.sub(r"[^\w-]", "_", topics.name) / kind, kind == "depth"))
    return extract_images(assembly.survey.recording, folders, ledger)


def _camera_log(
    topics: CameraTopics,
    camera: Camera,
    mount: Trajectory | None,
    images: dict[str, Images],
    options: BagOptions,
    ledger: Ledger,
) -> CameraLog:
    camera = replace(camera, depth_scale=DEPTH_SCALE)
    rgb, depth = (images.get(shown.name) if shown else None for shown in (topics.image, topics.depth))
    detections, topic = None, topics.detections
    if topic is not None:
        boxes = replace(topic.boxes, stamps=(topic.times() / 1e9).tolist(), boxes=list(topic.boxes.boxes))
        if topic.points:
            projected = boxes_of_points(camera, np.array(list(topic.points.values())))
            for index, box in zip(topic.points, projected.tolist(), strict=True):
                boxes.boxes[index] = box
        detections = replace(boxes.checked(ledger), whole=is_tags(topic.type))
    if detections is not None and depth is not None and options.with_range:
        detections = depths_at_boxes(detections, depth, camera, ledger)
    return CameraLog(camera, detections, rgb, depth, mount)


def extract_images(recording: Recording, folders: Mapping[str, tuple[Path, bool]], ledger: Ledger) -> dict[str, Images]:
    """Write the images of topics into files. Return the written images of each topic.

    folders: for each topic, the target folder and whether the topic has depth images. Colour images in JPEG or PNG are
    copied. Other colour images become PNG. Depth images become 16 bit PNG with `DEPTH_SCALE` units per metre. Their value 0
    is an unknown depth. The name of a file is the stamp of its image, s. Images that cannot be decoded, or whose stamp
    repeats or goes back, are dropped and counted. Only one image is in memory at a time. Raises LogError if a file cannot be
    written.
    """
    written: dict[str, dict[int, Path]] = {topic: {} for topic in folders}
    decoders: dict[int, tuple[Connection, Callable[[bytes], Any]]] = {}
    reports: list[FileReport] = []
    for folder, _ in folders.values():
        with _writing("the folder for images cannot be made", folder):
            folder.mkdir(parents=True, exist_ok=True)
    for connection, logged, data in read_messages(recording, lambda connection: connection.topic in folders, reports):
        folder, depth = folders[connection.topic]
        place = f"{connection.topic} at {logged / 1e9:.3f} s"
        try:
            if id(connection) not in decoders:
                decoders[id(connection)] = connection, make_decoder(connection)
            stamp = read_head(data, connection.encoding)[0] or logged
            if stamp in written[connection.topic]:
                ledger.drop("image with a stamp that repeats", where=place)
                continue
            message = decoders[id(connection)][1](data)
            content, ending = image_file(message, depth)
        except DecodeError as error:
            ledger.drop(f"image that cannot be decoded ({error})", where=place)
            continue
        path = folder / f"{stamp // 10**9}.{stamp % 10**9:09d}{ending}"
        with _writing("an image cannot be written", path):
            path.write_bytes(content)
        written[connection.topic][stamp] = path
    found = {}
    for topic, paths in written.items():
        seconds = np.array(list(paths), dtype=np.int64) / 1e9
        forward = in_order(seconds)
        late = (f"{topic} at {stamp:.3f} s" for stamp in seconds[~forward].tolist())
        count_drops("image with a stamp that goes back", int((~forward).sum()), late, ledger)
        if forward.any():
            found[topic] = Images(seconds[forward], tuple(compress(paths.values(), forward)))
    return found


@contextmanager
def _writing(what: str, path: Path) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        raise LogError(f"{what}: {error.strerror or error}", where=str(path)) from error
