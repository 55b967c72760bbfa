"""A summary of a ROS bag for `objslam info`: its content, and the role of each topic in a run."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from objslam.core.camera import Camera, spoken_name
from objslam.core.diagnostics import Ledger
from objslam.ros.messages.topic_types import COMPRESSED
from objslam.sources.ros_bag.log import Assembly, assemble
from objslam.sources.ros_bag.options import BagOptions
from objslam.sources.ros_bag.places import CameraPlace, camera_places
from objslam.sources.ros_bag.survey import Topic
from objslam.sources.summary import FIND_BOXES, Timing, off_path, timing


@dataclass(frozen=True)
class TopicInfo:
    """One topic of a bag.

    messages: the number of messages. timing: the timing of the messages by their header stamps. For tf and for types that
    objslam does not use, the times of recording are taken. role: the role in a run, "" without a role. frame: the most
    frequent frame_id. detail: a short description of the messages. refused: the reasons why messages are unusable, each
    with the number of messages.
    """

    name: str
    type: str
    messages: int
    timing: Timing
    role: str
    frame: str
    detail: str
    refused: tuple[str, ...]


@dataclass(frozen=True)
class BagInfo:
    """The summary of a bag.

    start, end: the times at which the first and the last message were recorded, s, 0 without messages. messages: the number
    of messages that were read. lost: the number of messages that cannot be read because of damage. base: the base frame.
    odometry, localization: the topic or transform that gives this path, "" without this path. places: the optical frames
    that tf connects to base. missing: one line for each thing that a run needs but the bag lacks. damage: one line for each
    kind of damage in each file. warnings: the warnings that a run would give.
    """

    name: str
    format: str
    files: tuple[str, ...]
    start: float
    end: float
    messages: int
    lost: int
    topics: tuple[TopicInfo, ...]
    base: str
    odometry: str
    localization: str
    cameras: tuple[Camera, ...]
    places: tuple[CameraPlace, ...]
    missing: tuple[str, ...]
    damage: tuple[str, ...]
    warnings: tuple[str, ...]


def describe(paths: Path | Sequence[Path], options: BagOptions | None = None) -> BagInfo:
    """Return the summary of a bag. paths: as in `read_bag`.

    Raises LogError if no file can be read, and ConfigError for options that do not fit the bag.
    """
    options = options or BagOptions()
    ledger = Ledger()
    assembly = assemble(paths, ledger, options)
    survey, found, roles = assembly.survey, assembly.paths, _roles(assembly)
    logged = [np.frombuffer(topic.logged, dtype=np.int64) for topic in survey.topics.values()]
    return BagInfo(
        name=survey.recording.name,
        format=survey.recording.format,
        files=tuple(str(file.path) for file in survey.recording.files),
        start=min((float(times.min()) for times in logged), default=0.0) / 1e9,
        end=max((float(times.max()) for times in logged), default=0.0) / 1e9,
        messages=sum(report.messages for report in survey.reports),
        lost=sum(report.lost for report in survey.reports),
        topics=tuple(_topic_info(topic, roles.get(topic.name, "")) for _, topic in sorted(survey.topics.items())),
        base=assembly.base if found or assembly.tree.frames else "",
        odometry=found.odometry_from if found else "",
        localization=found.localization_from if found else "",
        cameras=tuple(camera for _, camera, _ in assembly.cameras),
        places=camera_places(assembly.tree, assembly.base),
        missing=_missing(assembly),
        damage=survey.damage(),
        warnings=tuple(ledger.lines()),
    )


def _missing(assembly: Assembly) -> tuple[str, ...]:
    missing = [str(error) for error in (*assembly.problems, *assembly.left_out)]
    found = assembly.paths
    paths = () if found is None else (found.localization, found.odometry)
    path = next((one for one in paths if one is not None), None)
    for topics, camera, _ in assembly.cameras:
        where, frames = spoken_name(camera.name), topics.detections or topics.image
        if frames is topics.image is not None:
            missing.append(f"{where}: no detections; {FIND_BOXES}")
        if frames is not None:
            missing += off_path(where, frames.times() / 1e9, path)
    return tuple(missing)


def _roles(assembly: Assembly) -> dict[str, str]:
    roles = {}
    for name in assembly.survey.topics:
        if name in assembly.tf_topics:
            roles[name] = "tf_static" if name.endswith("tf_static") else "tf"
    if assembly.paths is not None:
        roles.update(assembly.paths.roles)
    for topics in assembly.cast:
        prefix = f"{topics.name}." if len(assembly.cast) > 1 else ""
        for role in ("detections", "image", "depth", "camera_info"):
            if topic := getattr(topics, role.removeprefix("camera_")):
                roles[topic.name] = prefix + role
    return roles


def _topic_info(topic: Topic, role: str) -> TopicInfo:
    stamps = topic.times() if topic.stamps else np.frombuffer(topic.logged, dtype=np.int64)
    refused = tuple(f"{count} {reason}" for reason, count in topic.refused.items())
    when, detail = timing(stamps / 1e9), _detail(topic)
    return TopicInfo(topic.name, topic.type, len(topic.logged), when, role, topic.frame, detail, refused)


def _detail(topic: Topic) -> str:
    if topic.poses:
        return ", ".join(" -> ".join(filter(None, pair)) for pair in list(topic.poses)[:3])
    if topic.boxes.stamps:
        return f"{len(topic.boxes.boxes)} boxes of {len(set(topic.boxes.labels))} labels"
    if topic.infos:
        info = next(iter(topic.infos.values()))
        return f"{info.width}x{info.height} {info.distortion_model}"
    if topic.image is not None:
        image = topic.image
        return str(image.format) if topic.type == COMPRESSED else f"{image.width}x{image.height} {image.encoding}"
    return ""
