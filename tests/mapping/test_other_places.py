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


def things(*, moves: bool) -> Log:
    """A drive with 12 things of 11 labels: two are carts. moves: the first cart is seen before the middle of the drive, and
    the second one after it, so that they are one cart."""
    log = simulate(preset("demo", objects=12, classes=12, tracks="perfect", frames=260, false=0.0), 1)
    (camera,) = log.cameras
    found = camera.detections
    number = np.bincount(found.track_ids[found.track_ids >= 0], minlength=12)
    first, second = np.argsort(-number)[:2]
    here, there = found.track_ids == first, found.track_ids == second
    label = found.label[here][0]
    left = np.ones(len(found.label), dtype=bool)
    if moves:
        middle = np.median(found.stamps[found.frame])
        late = found.stamps[found.frame] > middle
        left = ~((here & late) | (there & ~late))
    names = tuple("cart" if i == label else name for i, name in enumerate(found.label_names))
    changed = replace(
        found,
        label=np.where(there, label, found.label),
        label_names=names,
        track_ids=np.full(len(found.label), -1),
    )
    return replace(log, cameras=(replace(camera, detections=changed.take(left)),))


def mapped(log: Log) -> RunResult:
    return pipeline.run(log, load_settings(None, ("output.recording=false",)), Ledger())


@pytest.mark.parametrize("moves", [False, True])
def test_a_cart_at_two_places_is_doubted_and_two_carts_are_not(moves: bool) -> None:
    result = mapped(things(moves=moves))
    carts = {o.id for o in result.map.resolved() if o.label == "cart"}
    assert len(carts) == 2
    doubts = [one for one in result.doubts if one.reason == "moved"]
    said = [one for one in result.summary["assessment"]["reasons"] if "one thing that moved" in one]
    if not moves:
        assert not doubts
        assert not said
        return
    (doubt,) = doubts
    assert set(doubt.objects) == carts
    assert min(doubt.numbers["frames_after"], doubt.numbers["frames_before"]) >= 10
    assert result.summary["assessment"]["level"] == "check"
    assert "cart" in said[0]


def test_the_largest_value_of_other_labels_is_that_of_a_search() -> None:
    rng = np.random.default_rng(0)
    for _ in range(200):
        value = rng.integers(0, 9, rng.integers(1, 12))
        label = np.unique(rng.integers(0, 4, len(value)), return_inverse=True)[1]
        searched = [max(value[label != mine], default=0) for mine in label]
        assert _largest_of_others(value, label).tolist() == searched
