"""Doubts about objects that may be where the rays of two things cross."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from doubtful_drives import clean_rooms

from objslam.association.crossings.one_or_two import find_crossings
from objslam.core.result import RunResult, doubtful_ids
from objslam.mapping.doubts import disagreeing
from objslam.mapping.doubts.evidence import evidence_of
from objslam.mapping.doubts.find import with_doubts


@pytest.fixture(scope="module")
def rooms() -> RunResult:
    return clean_rooms("perfect")


def test_objects_of_a_clean_drive_are_no_crossings(rooms):
    assert disagreeing.crossing(rooms, evidence_of(rooms)) == []


def test_an_object_is_doubted_if_it_is_more_likely_not_one_thing(rooms, monkeypatch):
    """With an existence of 0.9, the odds 1 : 1 of one thing are a probability of 0.45, and the odds e : 1 are 0.66."""
    objects = tuple(replace(o, existence=0.9) for o in rooms.map.objects)
    result = replace(rooms, map=replace(rooms.map, objects=objects))
    odds = {0: 0.0, 1: 1.0, 2: -2.0}

    def given(state, sized, fewest):
        found = find_crossings(state, sized, fewest)
        return replace(found, odds=np.array([odds.get(k, 5.0) for k in range(len(found.landmark))]))

    monkeypatch.setattr(disagreeing, "find_crossings", given)
    evidence = evidence_of(result)
    sized = np.ones(len(evidence.state.obs), dtype=bool)
    landmark = find_crossings(evidence.state, sized, 1).landmark
    found = disagreeing.crossing(result, evidence)
    named = [result.map.objects[evidence.object[landmark[k]]].id for k in (2, 0)]  # The likeliest crossing comes first.
    assert [doubt.objects for doubt in found] == [(number,) for number in named]
    assert [1 - doubt.numbers["probability"] for doubt in found] == pytest.approx([0.9 / (1 + np.exp(2)), 0.45])
    assert doubtful_ids(found, ["split"]) == set(named)  # The pictures mark them.
    assert len(disagreeing.in_assessment(found)) == 1
    known = tuple(replace(o, existence=None) for o in objects)  # Names that are given say nothing of existence.
    found = disagreeing.crossing(replace(result, map=replace(result.map, objects=known)), evidence)
    assert [doubt.numbers["log_odds"] for doubt in found] == pytest.approx([2.0])


def test_an_object_that_too_few_frames_show_is_doubted(rooms):
    """The lowest existence comes first. An object of a clean drive has no such doubt."""
    assert disagreeing.rarely_seen(rooms) == []
    existence = dict(zip((o.id for o in rooms.map.objects[:3]), (0.79, 0.81, 0.55), strict=True))
    objects = tuple(replace(o, existence=existence.get(o.id, o.existence)) for o in rooms.map.objects)
    result = replace(rooms, map=replace(rooms.map, objects=objects))
    low, _, lowest = (o.id for o in objects[:3])
    found = disagreeing.rarely_seen(result)
    assert [one.objects for one in found] == [(lowest,), (low,)]
    whole = with_doubts(result)
    named = [one for one in whole.doubts if one.reason == "rarely seen"]
    assert {one.objects for one in named} == {(lowest,), (low,)}
    assert doubtful_ids(named, ["split"]) == {lowest, low}  # The pictures mark them.
    # They do not make a map bad, and do not start a solve of the poses, because they are no sign of wrong poses.
    assert whole.summary["doubtful_objects"] == with_doubts(rooms).summary["doubtful_objects"]
    (said,) = [one for one in whole.summary["assessment"]["reasons"] if "may be no thing" in one]
    assert said.startswith("2 objects are missing in too many frames that should show them (")


@pytest.mark.parametrize("existence", [None, 0.8, 1.0])
def test_an_object_that_enough_frames_show_is_not_doubted(rooms, existence):
    objects = tuple(replace(o, existence=existence) for o in rooms.map.objects)
    assert disagreeing.rarely_seen(replace(rooms, map=replace(rooms.map, objects=objects))) == []
