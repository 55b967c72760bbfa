"""Choose the tf topics of one robot. Several robots often use the same frame names, each on its own tf topic."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from objslam.ros.messages.poses import PoseRows
from objslam.ros.messages.topic_types import TRANSFORMS
from objslam.ros.tf.tree import TfRows
from objslam.ros.topics import NONE, TF, TF_ROLES, namespace, warn_of_choice
from objslam.sources.ros_bag.survey import Topic
from objslam.sources.ros_bag.topic_roles import TopicPool, candidates

_REPEATED = 0.5
"""The least share of the samples of a transform, on the topic with fewer samples, that the other topic also has if one topic
repeats the other, as a relay does. With a smaller share, the topics belong to two robots. Two robots share hardly a sample,
and a relay shares nearly all. With a larger value, a relay that changes some samples counts as another robot."""


def choose_robot(pool: TopicPool) -> tuple[TfRows, TopicPool]:
    """Return the transforms of one robot, and the topics without the topics of other robots.

    All namespaces of tf topics are used if the user chose none and no two namespaces have different samples of the same
    moving transform. The user's choice (`--topic tf=...`) has priority. Without this choice, the namespace of the topics
    that the user chose for other roles comes first, then the namespace of the first topic of odometry, boxes or images. A
    warning names the namespaces that are left out. Topics that the user chose always stay.
    """
    by_space, topics = pool.survey.tf, pool.survey.topics
    chosen = [name for role in TF_ROLES for name in pool.choices.of(role)]
    taken = sorted({namespace(name) for name in chosen if name != NONE})
    if not chosen:
        for space in _by_priority(pool, by_space):
            if not any(_differ(by_space[space], by_space[other]) for other in taken):
                taken.append(space)
        if left := sorted(by_space.keys() - set(taken)):
            warn_of_choice(pool.ledger, TF, f"{taken[0]}/tf", (f"{space}/tf" for space in left))
    named = {name for names in pool.choices.names.values() for name in names}
    mine = {name: topic for name, topic in topics.items() if name in named or _space_of(topic, by_space) in (None, *taken)}
    return _merged([by_space[space] for space in taken]), replace(pool, survey=replace(pool.survey, topics=mine))


def _space_of(topic: Topic, spaces: Iterable[str]) -> str | None:
    """Return the namespace of tf that contains a topic, or None if no namespace contains it."""
    if topic.type in TRANSFORMS:
        return namespace(topic.name)
    return max((space for space in spaces if space and topic.name.startswith(f"{space}/")), key=len, default=None)


def _by_priority(pool: TopicPool, by_space: Mapping[str, TfRows]) -> list[str]:
    """Return the namespaces of tf in the order of priority. The longest one that contains the robot's topic is first."""
    named = [name for (_, role), names in pool.choices.names.items() if role not in TF_ROLES for name in names]
    named = [name for name in named if name not in (NONE, TF)]
    found = [found[0].name for role in ("odometry", "detections", "image") if (found := candidates(pool.survey, role))]
    robot = (named or found or [""])[0]
    holds = {space: robot.startswith(f"{space}/") for space in by_space}
    return sorted(by_space, key=lambda space: (not holds[space], -len(space) if holds[space] else 0, space))


def _differ(one: TfRows, other: TfRows) -> bool:
    """Return whether two namespaces have different samples of the same moving transform."""
    return any(not _repeats(one.moving[pair], other.moving[pair]) for pair in one.moving.keys() & other.moving.keys())


def _repeats(one: PoseRows, other: PoseRows) -> bool:
    a, b = _samples(one), _samples(other)
    return len(np.intersect1d(a, b)) >= _REPEATED * min(len(a), len(b))


def _samples(rows: PoseRows) -> NDArray[np.void]:
    """Return the samples (N,) of a transform without repeats. Each sample is the bytes of its stamp and pose."""
    stamps, values = np.frombuffer(rows.stamps, dtype=np.int64), np.frombuffer(rows.values).reshape(-1, 7)
    table = np.column_stack([stamps.view(np.float64), values])
    return np.unique(table.view(np.dtype((np.void, table.strides[0])))[:, 0])


def _merged(parts: Sequence[TfRows]) -> TfRows:
    if len(parts) == 1:
        return parts[0]
    merged = TfRows()
    for part in parts:
        merged.refused.update(part.refused)
        merged.static.update(part.static)
        for pair, rows in part.moving.items():
            into = merged.moving.setdefault(pair, PoseRows())
            into.stamps.extend(rows.stamps)
            into.logged.extend(rows.logged)
            into.values.extend(rows.values)
    return merged
