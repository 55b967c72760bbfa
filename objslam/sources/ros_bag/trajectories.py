"""Read the robot's paths (odometry and localisation) from topics and the tf tree."""

from dataclasses import dataclass, field, replace

import numpy as np

from objslam.core.arrays import Floats
from objslam.core.diagnostics import Ledger
from objslam.core.trajectory import Trajectory
from objslam.errors import LogError
from objslam.io.text import count_drops, in_order
from objslam.ros.messages.topic_types import ODOMETRY
from objslam.ros.tf.frames import find_base, find_odom, find_world, is_world
from objslam.ros.tf.tree import TfTree
from objslam.ros.topics import NONE, TF
from objslam.sources.ros_bag.survey import Survey, Topic
from objslam.sources.ros_bag.topic_roles import TopicPool, candidates

_NOT_THE_ROBOT = ("goal", "target", "initial", "setpoint", "waypoint", "truth", "mocap", "vrpn", "vicon")
"""Words in the names of topics whose poses are not the robot's own estimate of its pose. Without a choice of the user, these
topics are not used."""


@dataclass(frozen=True)
class Paths:
    """The robot's paths. base: the name of the base frame. odometry: odom_T_base. localization: map_T_base.

    odometry_from, localization_from: a text for the user that names the topic or transform of the path, "" without the path.
    roles: maps the name of each topic that is used to its role.
    """

    base: str
    odometry: Trajectory | None = None
    localization: Trajectory | None = None
    odometry_from: str = ""
    localization_from: str = ""
    roles: dict[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class _Odometry:
    """Poses (N, 4, 4) of the frame `child` in `frame` at stamps (N,), s. source: the topic or transform that gives them."""

    frame: str
    child: str
    stamps: Floats
    poses: Floats
    source: str


def read_paths(pool: TopicPool, tree: TfTree, base_frame: str | None) -> Paths:
    """Return the odometry and the localisation of the robot's base.

    The odometry comes from a nav_msgs/Odometry topic. Without such a topic, the odometry is tf from odom to base. The
    localisation is tf from map to odom, multiplied by the odometry at the odometry's stamps. If the odometry's frame is not
    in tf, the localisation is tf from map to base. If map is not in tf, the localisation comes from a topic of poses in map.
    If map never moves against odom, the odometry is converted to map, and the localisation is None. The user may choose
    other topics, or tf. Raises LogError if both paths are missing, if a topic has no usable pose, or if tf does not connect
    a necessary frame.
    """
    ledger = pool.ledger
    topics = [topic for topic in candidates(pool.survey, "odometry") if not is_world(_main_pair(topic)[0])]
    topic = pool.choose("odometry", topics)
    odometry = None if topic is None else _from_topic(topic, "odometry message", ledger)
    moved = odometry.child if odometry else next((_main_pair(topic)[1] for topic in _pose_topics(pool.survey)), "")
    base = find_base(tree.frames, base_frame, moved)
    if base_frame is None and moved not in ("", base):
        ledger.warn(f"the poses are of the frame {moved!r}, which is not in tf; {base!r} is used instead")
    if odometry is not None:
        odometry = _moved_to(base, odometry, tree, ledger)
    elif pool.choices.of("odometry") != [NONE]:
        odometry = _odometry_from_tf(tree, base)
    paths = _localized(pool, tree, odometry, base)
    if topic is not None:
        paths = replace(paths, roles={topic.name: "odometry", **paths.roles})
    if paths.odometry is None and paths.localization is None:
        odom = find_odom(tree.frames)
        apart = f": tf has {odom!r}, but not its transform to {base!r}" if odom and base != odom else ""
        raise LogError(
            f"there is neither odometry nor localisation{apart}",
            where=pool.survey.recording.name,
            hint="record a nav_msgs/Odometry topic, tf from odom or map to base, or poses in map",
        )
    return paths


def _main_pair(topic: Topic) -> tuple[str, str]:
    return max(topic.poses, key=lambda pair: len(topic.poses[pair]))


def _from_topic(topic: Topic, what: str, ledger: Ledger) -> _Odometry:
    """Return the poses of a topic. Messages with other frames than the most frequent pair of frames are dropped and counted.

    what: the name of a message in the ledger. Raises LogError if no pose is usable.
    """
    pair = _main_pair(topic)
    for other, rows in topic.poses.items():
        if other != pair:
            ledger.drop(f"{what} in other frames than most messages", len(rows), f"{topic.name}: {' -> '.join(other)}")
    stamps, poses = topic.poses[pair].checked(what, ledger)
    forward = in_order(stamps)
    places = [f"{topic.name} at {stamp:.3f} s" for stamp in stamps[~forward].tolist()]
    count_drops(f"{what} with a stamp that repeats or goes back", len(places), places, ledger)
    if not forward.any():
        raise LogError("none of the topic's messages has a usable pose", where=topic.name)
    return _Odometry(*pair, stamps[forward], poses[forward], topic.name)


def _moved_to(base: str, odometry: _Odometry, tree: TfTree, ledger: Ledger) -> _Odometry:
    child = odometry.child
    if child in ("", base):
        return odometry
    if child not in tree.frames or base not in tree.frames:
        ledger.warn(f"tf does not connect the path's frame {child!r} to {base!r}: both count as the same frame")
        return odometry
    child_T_base, known = tree.at(child, base, odometry.stamps)
    ledger.drop(f"odometry message with a stamp at which tf {child} -> {base} is not known", int((~known).sum()))
    if not known.any():
        raise LogError(f"tf {child} -> {base} is not known at any stamp of the odometry", where=odometry.source)
    return replace(odometry, child=base, stamps=odometry.stamps[known], poses=(odometry.poses @ child_T_base)[known])


def _odometry_from_tf(tree: TfTree, base: str) -> _Odometry | None:
    if base not in tree.frames:
        return None
    frame = find_odom(tree.above(base))
    if frame in ("", base) or tree.still(frame, base) is not None:
        return None
    stamps, poses = tf_path(tree, frame, base)
    return _Odometry(frame, base, stamps, poses, f"tf {frame} -> {base}") if len(stamps) else None


def tf_path(tree: TfTree, frame: str, child: str) -> tuple[Floats, Floats]:
    """Return the stamps (N,), s, at which tf has the pose of the frame `child` in `frame`, and the poses (N, 4, 4)."""
    stamps = tree.stamps(frame, child)
    poses, known = tree.at(frame, child, stamps)
    return stamps[known], poses[known]


def _localized(pool: TopicPool, tree: TfTree, odometry: _Odometry | None, base: str) -> Paths:
    """Return the odometry and the localisation. If the user made no choice, tf is tried before the topics of poses."""
    chosen = pool.choices.of("localization")
    path, source = (None, "") if odometry is None else (Trajectory(odometry.stamps, odometry.poses), odometry.source)
    if chosen in ([], [TF]):
        found = _from_tf(tree, odometry, base)
        if found is not None:
            stamps, poses, name = found
            if odometry is not None and len(stamps) == 0:  # The frame map never moves against odom.
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
    """Return the localisation from tf: stamps (N,), s, poses map_T_base (N, 4, 4), and a text that names the source.

    If map does not move against odom, the stamps are empty, and the fixed map_T_odom (4, 4) is returned instead of the
    poses. Return None if tf has no localisation.
    """
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
        stamps, poses = tf_path(tree, world, base)
        return (stamps, poses, f"tf {world} -> {base}") if len(stamps) else None
    if still is not None:
        return np.zeros(0), still, f"{world} (it does not move against {frame})"
    map_T_odom, known = tree.at(world, frame, odometry.stamps)
    if not known.any():
        return None
    return odometry.stamps[known], (map_T_odom @ odometry.poses)[known], f"tf {world} -> {frame} with {odometry.source}"
