"""A part of a recorded drive, and drives whose landmarks share labels."""

from dataclasses import replace

import numpy as np

from objslam.core.arrays import Ints
from objslam.core.types import Detections, Log
from objslam.frontend.log_part import part_of_log


def part(log: Log, begin: float, end: float) -> Log:
    """The log between two times after its start, s."""
    assert log.robot_path is not None
    start = log.robot_path.stamps[0]
    return part_of_log(log, start + begin, start + end)


def without_names(log: Log) -> Log:
    """The log, and its truth if it has one, with one label for all landmarks."""
    return _relabelled(log, dict.fromkeys(_names(log), "landmark"))


def with_classes(log: Log, number: int, seed: int = 0) -> Log:
    """The log, and its truth if it has one, with a number of labels. Chance gives about as many landmarks to each label."""
    order = np.random.default_rng(seed).permutation(_names(log))
    return _relabelled(log, {str(name): f"class_{i % number}" for i, name in enumerate(order)})


def _names(log: Log) -> list[str]:
    """The names of the labels of all cameras, sorted."""
    return sorted({name for c in log.cameras if c.detections is not None for name in c.detections.label_names})


def _relabelled(log: Log, new: dict[str, str]) -> Log:
    """The log with other labels. new: the new name of each label."""
    names = tuple(sorted(set(new.values())))
    cameras = tuple(
        replace(c, detections=replace(found, label=_index(found, new, names)[found.label], label_names=names))
        for c in log.cameras
        if (found := c.detections) is not None
    )
    if log.truth is None:
        return replace(log, cameras=cameras)
    objects = tuple(replace(one, label=new.get(one.label, one.label)) for one in log.truth.objects)
    return replace(log, cameras=cameras, truth=replace(log.truth, objects=objects))


def _index(found: Detections, new: dict[str, str], names: tuple[str, ...]) -> Ints:
    """The number of the new name of each label."""
    return np.array([names.index(new[name]) for name in found.label_names], dtype=np.int64)
