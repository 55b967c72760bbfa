"""The robot's path: odometry and localisation, out of topics and the tf tree."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from objslam.core.arrays import Floats
from objslam.core.diagnostics import Ledger
from objslam.core.types import Trajectory
from objslam.errors import LogError
from objslam.io.text import count_drops, in_order
from objslam.ros.messages.topic_types import ODOMETRY
from objslam.ros.tf.frames import find_base, find_odom, find_world, is_world
from objslam.ros.tf.tree import TfTree
from objslam.ros.topics import NONE, TF
from objslam.sources.ros_bag.survey import Survey, Topic
from objslam.sources.ros_bag.topic_roles import TopicPool, candidates

_NOT_THE_ROBOT = ("goal", "target", "initial", "setpoint", "waypoint", "truth", "mocap", "vrpn", "vicon")
"""Words in the names of pose topics that tell something other than where the robot takes itself to be."""


@dataclass(frozen=True)
class Paths:
    """odom_T_base and map_T_base, where each comes from, in words ("" if it is missing), and the frame that base is.

    roles: the role of each topic that was used.
    """

    base: str
    odometry: Trajectory | None = None
    localization: Trajectory | None = None
    odometry_from: str = ""
    localization_from: str = ""
    roles: dict[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class _Odometry:
    """Odometry before it is decided what base is: poses of `child` in `frame`."""

    frame: str
    child: str
    stamps: Floats
    poses: Floats
    source: str


def read_paths(pool: TopicPool, tree: TfTree, base_frame: str | None) -> Paths:
    """Odometry and localisation of the robot's base.

    Odometry is a nav_msgs/Odometry topic, else tf from odom to base. Localisation is tf from map to odom, composed with the
    odometry at its stamps, else a topic of poses in map. A map that never moves against odom is no localisation: it only
    renames the frame, and the odometry is given in it. LogError where frames that must be connected are not, or there is
    neither of the two.
    """
    ledger = pool.ledger
    topics = [topic for topic in candidates(pool.survey, "odometry") if not is_world(_main_pair(topic)[0])]
    topic = pool.choose("odometry", topics)
    odometry = None if topic is None else _from_topic(topic, "odometry message", ledger)
    moved = odometry.child if odometry else next((_main_pair(topic)[1] for topic in _pose_topics(pool.survey)), "")
    base = find_base(tree.frames, base_frame, moved)
    if base_frame is None and moved not in ("", base):
        ledger.warn(f"the path is that of {moved!r}, which is not in tf: {base!r} is taken to be the same")
    if odometry is not None:
        odometry = _moved_to(base, odometry, tree, ledger)
    elif pool.choices.of("odometry") != [NONE]:
        odometry = _odometry_from_tf(tree, base)
    paths = _localized(pool, tree, odometry, base)
    if topic is not None:
        paths = replace(paths, roles={topic.name: "odometry", **paths.roles})
    if paths.odometry is None and paths.localization is None:
        raise LogError(
            "there is neither odometry nor localisation",
            where=pool.survey.recording.name,
            hint="a nav_msgs/Odometry topic, tf from odom or map to base, or poses in map are needed",
        )
    return paths


def _main_pair(topic: Topic) -> tuple[str, str]:
    return max(topic.poses, key=lambda pair: len(topic.poses[pair]))


def _from_topic(topic: Topic, what: str, ledger: Ledger) -> _Odometry:
    """The poses of the pair of frames that most messages of the topic are in; the others are counted."""
    pair = _main_pair(topic)
    for other, rows in topic.poses.items():
        if other != pair:
            ledger.drop(f"{what} in other frames than most", len(rows), f"{topic.name}: {' -> '.join(other)}")
    stamps, poses = topic.poses[pair].checked(what, ledger)
    forward = in_order(stamps)
    late = stamps[~forward].tolist()
    places = (f"{topic.name} at {stamp:.3f} s" for stamp in late)
    count_drops(f"{what} with a stamp that repeats or goes back", len(late), places, ledger)
    if not forward.any():
        raise LogError("no message of it has a usable pose", where=topic.name)
    return _Odometry(*pair, stamps[forward], poses[forward], topic.name)


def _moved_to(base: str, odometry: _Odometry, tree: TfTree, ledger: Ledger) -> _Odometry:
    child = odometry.child
    if child in ("", base):
        return odometry
    if child not in tree.frames or base not in tree.frames:
        ledger.warn(f"the path is that of {child!r}, which tf does not connect to {base!r}: it is taken to be the same")
        return odometry
    child_T_base, known = tree.at(child, base, odometry.stamps)
    ledger.drop(f"odometry message at whose time tf {child} -> {base} is not known", int((~known).sum()))
    if not known.any():
        raise LogError(f"tf {child} -> {base} is known at no time of the odometry", where=odometry.source)
    moved = (odometry.poses @ child_T_base)[known]
    return _Odometry(odometry.frame, base, odometry.stamps[known], moved, odometry.source)


def _odometry_from_tf(tree: TfTree, base: str) -> _Odometry | None:
    if base not in tree.frames:
        return None
    frame = find_odom(tree.above(base))
    if frame in ("", base) or tree.still(frame, base) is not None:
        return None
    stamps = tree.stamps(frame, base)
    poses, known = tree.at(frame, base, stamps)
    return _Odometry(frame, base, stamps[known], poses[known], f"tf {frame} -> {base}") if known.any() else None


def _localized(pool: TopicPool, tree: TfTree, odometry: _Odometry | None, base: str) -> Paths:
    """The paths, with the localisation that was chosen or that is there."""
    chosen = pool.choices.of("localization")
    path, source = (None, "") if odometry is None else (Trajectory(odometry.stamps, odometry.poses), odometry.source)
    if chosen in ([], [TF]):
        found = _from_tf(tree, odometry, base)
        if found is not None:
            stamps, poses, name = found
            if odometry is not None and len(stamps) == 0:  # map never moves against odom
                return Paths(base, Trajectory(odometry.stamps, poses @ odometry.poses), None, f"{source}, in {name}")
            return Paths(base, path, Trajectory(stamps, poses), source, name)
    fitting = [] if chosen == [TF] else _pose_topics(pool.survey)
    topic = pool.choose("localization", fitting)
    if topic is None:
        return Paths(base, path, None, source)
    localization = _moved_to(base, _from_topic(topic, "localisation message", pool.ledger), tree, pool.ledger)
    roles = {topic.name: "localization"}
    return Paths(base, path, Trajectory(localization.stamps, localization.poses), source, topic.name, roles)


def _pose_topics(survey: Survey) -> list[Topic]:
    topics = [topic for topic in candidates(survey, "localization") if is_world(_main_pair(topic)[0])]
    return [t for t in topics if t.type == ODOMETRY or not any(word in t.name.lower() for word in _NOT_THE_ROBOT)]


def _from_tf(tree: TfTree, odometry: _Odometry | None, base: str) -> tuple[Floats, Floats, str] | None:
    """Stamps and map_T_base, and in words where from; no stamps and the constant map_T_odom where map does not move."""
    frame = odometry.frame if odometry is not None and odometry.frame in tree.frames else base
    if frame not in tree.frames:
        return None
    world = find_world(tree.above(frame))
    if world in ("", frame):
        return None
    still = tree.still(world, frame)
    if odometry is None or odometry.frame != frame:
        if still is not None:
            return None
        stamps = tree.stamps(world, base)
        poses, known = tree.at(world, base, stamps)
        return (stamps[known], poses[known], f"tf {world} -> {base}") if known.any() else None
    if still is not None:
        return np.zeros(0), still, f"{world} (it does not move against {frame})"
    map_T_odom, known = tree.at(world, frame, odometry.stamps)
    if not known.any():
        return None
    return odometry.stamps[known], (map_T_odom @ odometry.poses)[known], f"tf {world} -> {frame} with {odometry.source}"
