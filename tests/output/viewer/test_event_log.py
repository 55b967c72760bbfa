"""The decisions of a run in words."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from synthetic_result import clusters, synthetic_result

from objslam.core.object_map import MapObject, ObjectMap
from objslam.core.trace import Iteration, Round
from objslam.core.types import Association
from objslam.output.viewer.event_log import drive_events, map_changes, round_events


def a_round(why: str, owner: list[int], count: int, cost: float | None = 1.0, positions: object = None) -> Round:
    steps = (
        () if cost is None else (Iteration("solve", cost, np.zeros((2, 3), np.float32), np.zeros((count, 3), np.float32)),)
    )
    places = np.zeros((count, 3)) if positions is None else np.array(positions)
    association = Association(np.array(owner), np.zeros(count, dtype=np.int64))
    return Round(why, association, steps, np.tile(np.eye(4), (2, 1, 1)), places, np.ones(len(owner)))  # type: ignore[arg-type]


def test_where_the_rays_go_says_what_became_of_an_object() -> None:
    trace = (
        a_round("association", [0, 0, 0, 1, 1, 2, 2, 2, -1], 3, positions=[[0, 0, 0], [0.3, 0.4, 0], [5, 5, 0]]),
        # Objects 0 and 1 become one. Object 2 is gone. One of its rays and the unexplained ray are a new object.
        a_round("association", [0, 0, 0, 0, 0, -1, -1, 1, 1], 2, 0.5),
    )
    lines = [(line.at, line.level, line.text) for line in round_events(trace, ("cup",))]
    assert lines == [
        (0, "INFO", "round 1, association at the latest poses: 3 objects, 1 unexplained rays"),
        (0, "INFO", "new: cup #0, 3 rays"),
        (0, "INFO", "new: cup #1, 2 rays"),
        (0, "INFO", "new: cup #2, 3 rays"),
        (0, "INFO", "solved in 1 iterations, cost 1 to 1, 0 rays rejected"),
        (1, "INFO", "round 2, association at the latest poses: 2 objects, 2 unexplained rays"),
        (1, "INFO", "merged: cup #0 (3 rays), cup #1 (2 rays) are cup #0, 0.50 m apart"),
        (1, "INFO", "new: cup #1, 2 rays of other objects or unexplained"),
        (1, "INFO", "dropped: cup #2, 2 of its 3 rays are now unexplained"),
        (1, "INFO", "solved in 1 iterations, cost 0.5 to 0.5, 0 rays rejected"),
    ]


def test_labels_that_are_no_identities_are_said() -> None:
    texts = [line.text for line in round_events((a_round("labels", [0, 0], 1), a_round("association", [0, 0], 1)), ("cup",))]
    assert "round 1, one object assumed for each label: 1 objects, 0 unexplained rays" in texts
    assert "a label is not one object: too many rays disagreed with the only object of their label" in texts
    assert round_events((), ("cup",)) == []


def test_many_objects_are_not_all_told() -> None:
    lines = round_events((a_round("association", list(range(50)), 50),), ("cup",))
    assert sum(line.text.startswith("new") for line in lines) == 40
    assert "... and 10 more" in [line.text for line in lines]


def test_the_drive_says_when_and_why() -> None:
    result, _ = synthetic_result(*clusters(), keyframes=40, unresolved=(2,))
    lines = drive_events(dataclasses.replace(result, summary={**result.summary, "warnings": ["dropped 3: cut off"]}))
    texts = [line.text for line in lines]
    assert texts[0] == "14 objects, 1 unresolved, 600 rays, 40 keyframes"
    assert ("WARN", "dropped 3: cut off") in [(line.level, line.text) for line in lines]
    assert sum("first seen" in t for t in texts) == 15
    assert [line.at for line in lines] == sorted(line.at for line in lines)
    unresolved = next(line for line in lines if "unresolved," in line.text and "landmark" in line.text)
    assert (unresolved.level, unresolved.at) == ("WARN", result.map.objects[2].last_seen)
    assert "span 1.2 deg (triangulation.min_parallax_deg 3)" in unresolved.text


def test_an_object_has_a_place_once_its_rays_span_enough() -> None:
    result, _ = synthetic_result(*clusters(), keyframes=40)
    lines = {
        line.text.split(": ")[0].split(" s ")[1]: line.at for line in drive_events(result) if "rays now span" in line.text
    }
    for j in (0, 7):
        mine = np.flatnonzero((result.association.object == j) & (result.weight >= 0.5))
        n = result.directions[mine]
        first = next(i for i in range(len(n)) if np.degrees(np.arccos(np.clip(n[i] @ n[0], -1, 1))) >= 3.0)
        assert lines[result.map.objects[j].label] == pytest.approx(
            result.keyframes.stamps[result.rays.keyframe[mine[first]]]
        )


def an_object(number: int, x: float, status: str = "ok", label: str = "cup") -> MapObject:
    covariance = 1e-4 * np.eye(3) if status == "ok" else None
    return MapObject(number, label, np.array([x, 0.0, 0.0]), covariance, status, 9, 9, 12.0, 0.3, 0.0, 1.0)  # type: ignore[arg-type]


def test_a_live_map_tells_what_changed() -> None:
    before = ObjectMap((an_object(1, 0.0), an_object(2, 0.2), an_object(3, 5.0), an_object(4, 6.0, "unresolved")))
    now = ObjectMap((an_object(1, 0.0, "unresolved"), an_object(4, 6.0), an_object(5, 7.0), an_object(6, 8.0, "unresolved")))
    assert map_changes(before, now) == [
        ("WARN", "no longer resolved: cup #1, 9 rays, parallax 12 deg"),
        ("INFO", "resolved: cup #4, 9 rays, parallax 12 deg, sigma 1 cm"),
        ("INFO", "new: cup #5, 9 rays, parallax 12 deg"),
        ("INFO", "resolved: cup #5, 9 rays, parallax 12 deg, sigma 1 cm"),
        ("INFO", "new: cup #6, 9 rays, parallax 12 deg"),
        ("INFO", "dropped: cup #2, 9 rays, merged into cup #1"),
        ("INFO", "dropped: cup #3, 9 rays, its rays are now unexplained"),
    ]
    renamed = ObjectMap((an_object(1, 0.0, label="mug"),))
    assert map_changes(ObjectMap((an_object(1, 0.0),)), renamed) == [("INFO", "renamed: cup #1 is a mug")]
