"""A place that a map holds twice, made from a place whose objects are mapped again in another frame."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from doubtful_drives import clean_rooms

from objslam.core.arrays import Floats
from objslam.core.geometry import lift_se2
from objslam.core.object_map import MapObject, ObjectMap
from objslam.mapping.doubts import find
from objslam.mapping.doubts.find import with_doubts
from objslam.mapping.doubts.twice import find_twice

SIGMA = 0.05  # m
LOST = 60.0  # s


def objects(points: Floats, labels: list[str], first: Floats, last: Floats, number: int = 0) -> list[MapObject]:
    return [
        MapObject(number + i, label, point, SIGMA**2 * np.eye(3), "ok", 30, 30, 40.0, 0.5, begin, end)
        for i, (point, label, begin, end) in enumerate(zip(points, labels, first.tolist(), last.tolist(), strict=True))
    ]


def room(rng: np.random.Generator, count: int) -> tuple[Floats, list[str]]:
    return rng.uniform(0, 8, (count, 3)) * [1, 1, 0.2], [f"label_{k}" for k in rng.integers(0, 4, count)]


def mapped_again(points: Floats, rng: np.random.Generator) -> Floats:
    """The points in a frame that is turned and shifted, with noise."""
    turn = lift_se2(np.array([3.0, -2.0, 1.1]))
    return points @ turn[:3, :3].T + turn[:3, 3] + rng.normal(0, SIGMA, points.shape)


@pytest.mark.parametrize("spanning", [0, 4])
@pytest.mark.parametrize("seed", range(4))
def test_a_robot_that_was_carried_maps_the_place_twice(seed: int, spanning: int) -> None:
    """Some objects are seen on both sides of the loss, because they were taken for others."""
    rng = np.random.default_rng(seed)
    points, labels = room(rng, 12)
    first, second = rng.uniform(0, 30, 12), rng.uniform(LOST, 90, 12)
    last = np.where(np.arange(12) < spanning, 85.0, rng.uniform(30, LOST - 1, 12))
    before = objects(points, labels, first, last)
    after = objects(mapped_again(points, rng), labels, second, second + 10, 12)
    found = find_twice(ObjectMap(tuple(before + after), "odometry"))
    assert found is not None
    assert found.second == 12
    assert found.first == 12 - spanning
    assert {(i, k) for i, k in found.registration.matches.tolist()} == {(i, i + spanning) for i in range(12 - spanning)}
    assert LOST - 31 < found.stamp < LOST
    assert f"The {found.first} objects seen before stamp" in found.in_words()


@pytest.mark.parametrize("seed", range(10))
def test_a_drive_through_other_places_does_not(seed: int) -> None:
    rng = np.random.default_rng(seed)
    points, labels = room(rng, 40)
    points[:, 0] = np.sort(points[:, 0] * 5)
    first = np.linspace(0, 80, 40)
    assert find_twice(ObjectMap(tuple(objects(points, labels, first, first + 10)), "map")) is None


def test_a_place_that_is_seen_all_the_time_is_there_once() -> None:
    rng = np.random.default_rng(0)
    points, labels = room(rng, 20)
    assert find_twice(ObjectMap(tuple(objects(points, labels, np.zeros(20), np.full(20, 90.0))), "map")) is None
    assert find_twice(ObjectMap((), "map")) is None


def test_the_verdict_says_that_a_place_is_there_twice(monkeypatch: pytest.MonkeyPatch) -> None:
    result = clean_rooms()
    result = replace(result, summary={**result.summary, "assessment": {"level": "good", "reasons": ["All is well."]}})
    assert with_doubts(result).summary["assessment"]["level"] == "good"
    rng = np.random.default_rng(0)
    once = [replace(o, first_seen=1.0, last_seen=50.0) for o in result.map.objects]
    again = [replace(o, first_seen=LOST, last_seen=90.0, position=mapped_again(o.position[None], rng)[0]) for o in once]
    both = replace(result.map, objects=tuple(once + again))
    monkeypatch.setattr(find, "find_twice", lambda objects: find_twice(both))
    judged = with_doubts(result).summary["assessment"]
    assert judged["level"] == "check"
    assert "one place mapped twice" in judged["reasons"][0]
