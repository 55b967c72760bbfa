"""Two objects of one label that are one thing at two places are doubted."""

from dataclasses import replace

import numpy as np
import pytest

from objslam.config import load_settings
from objslam.core.diagnostics import Ledger
from objslam.core.result import RunResult
from objslam.core.types import Log
from objslam.mapping import pipeline
from objslam.mapping.moves.other_places import _largest_of_others
from objslam.simulation import preset, simulate

pytestmark = pytest.mark.usefixtures("one_start")


def things(moved: int) -> Log:
    """A drive of two laps with 24 things of 22 labels: two are carts, and two are bins. moved: how many of these two labels
    are one thing that moved. Its first place is seen before the middle of the drive, and its second one after it."""
    log = simulate(preset("demo", objects=24, classes=24, frames=520, laps=2, false=0.0), 1)
    (camera,) = log.cameras
    found = camera.detections
    late = found.stamps > np.median(found.stamps)
    number = np.minimum(*(np.bincount(found.label[half], minlength=24) for half in (late, ~late)))
    left, label, names = np.ones(len(found.label), dtype=bool), found.label.copy(), list(found.label_names)
    for k, (first, second) in enumerate(np.argsort(-number)[:4].reshape(2, 2)):
        here, there = found.label == first, found.label == second
        label[there] = first
        names[first] = ("cart", "bin")[k]
        if k < moved:
            left &= ~((here & late) | (there & ~late))
    changed = replace(found, label=label, label_names=tuple(names))
    return replace(log, cameras=(replace(camera, detections=changed.take(left)),))


def mapped(log: Log) -> RunResult:
    return pipeline.run(log, load_settings(None, ("output.recording=false",)), Ledger())


@pytest.mark.parametrize("moved", [0, 1, 2])
def test_things_at_two_places_are_doubted_and_two_things_are_not(moved: int) -> None:
    result = mapped(things(moved))
    doubts = [one for one in result.doubts if one.reason == "moved"]
    said = [one for one in result.summary["assessment"]["reasons"] if "one thing that moved" in one]
    assert [one.label for one in doubts] == sorted(("cart", "bin")[:moved])
    assert len(said) == min(moved, 1)
    for doubt in doubts:
        both = {o.id for o in result.map.resolved() if o.label == doubt.label}
        assert len(both) == 2
        assert set(doubt.objects) == both
        assert min(doubt.numbers["frames_after"], doubt.numbers["frames_before"]) >= 10
        assert doubt.label in said[0]
    if moved:
        assert result.summary["assessment"]["level"] == "check"


def test_the_largest_value_of_other_labels_is_that_of_a_search() -> None:
    rng = np.random.default_rng(0)
    for _ in range(200):
        value = rng.integers(0, 9, rng.integers(1, 12))
        label = np.unique(rng.integers(0, 4, len(value)), return_inverse=True)[1]
        searched = [max(value[label != mine], default=0) for mine in label]
        assert _largest_of_others(value, label).tolist() == searched
