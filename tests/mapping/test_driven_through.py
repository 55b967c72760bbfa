"""Objects that the robot drove through are doubted."""

from dataclasses import replace

import numpy as np
import pytest

from objslam.config import load_settings
from objslam.core.diagnostics import Ledger
from objslam.mapping import pipeline
from objslam.mapping.doubts.find import with_doubts
from objslam.mapping.moves.driven_through import driven_through
from objslam.simulation import preset, simulate


@pytest.fixture(scope="module")
def result():
    log = simulate(preset("demo", frames=150, false=0.0), 2)
    return pipeline.run(log, load_settings(None, ("output.recording=false",)), Ledger())


@pytest.fixture(scope="module")
def many():
    """22 things, of which 21 have a position. One of these is 5 %, and two are 10 %."""
    places = [(x, y, 0.4) for y in (1.2, -1.2) for x in np.linspace(-2.4, 2.4, 11).tolist()]
    placed = tuple((("mug", "bottle")[k % 2], place) for k, place in enumerate(places))
    log = simulate(preset("rooms", objects=0, placed=placed, false=0.0, missed=0.1), 0)
    return pipeline.run(log, load_settings(None, ("output.recording=false",)), Ledger())


def moved(result, j, position):
    """The result with one object at another place, and how its verdict is without the earlier doubts."""
    objects = list(result.map.objects)
    objects[j] = replace(objects[j], position=np.asarray(position, dtype=float))
    assessment = {"level": "good", "reasons": ["fine"]}
    return replace(
        result, map=replace(result.map, objects=tuple(objects)), summary={**result.summary, "assessment": assessment}
    )


def test_no_object_beside_the_path_is_doubted(result):
    assert any(o.body is not None for o in result.map)
    assert driven_through(result) == []


def test_an_object_on_the_path_is(result):
    j = next(j for j, o in enumerate(result.map) if o.body is not None)
    body, place = result.map[j].body, result.path_after.poses[len(result.path_after) // 2, :3, 3]
    found = with_doubts(moved(result, j, place + np.array([0.0, 0.0, body.size[2] / 2])))
    (doubt,) = [one for one in found.doubts if one.reason == "driven through"]
    assert doubt.objects == (result.map[j].id,)
    assert f"{result.map[j].label} #{result.map[j].id}" in doubt.text
    assert found.summary["assessment"]["level"] == "check"
    assert any("The robot drove through" in reason for reason in found.summary["assessment"]["reasons"])


@pytest.mark.parametrize("height", [-1.0, 2.0])
def test_an_object_above_or_below_the_robot_is_not(result, height):
    j = next(j for j, o in enumerate(result.map) if o.body is not None)
    place = result.path_after.poses[len(result.path_after) // 2, :3, 3]
    assert driven_through(moved(result, j, place + np.array([0.0, 0.0, height]))) == []


@pytest.mark.parametrize(("through", "level"), [(1, "good"), (2, "check")])
def test_one_of_many_objects_on_the_path_is_named_but_does_not_make_the_verdict(many, through, level):
    assert many.summary["assessment"]["level"] == "good"
    assert len(many.map.resolved()) == 21
    bodies = [j for j, o in enumerate(many.map) if o.body is not None]
    changed = many
    for k, j in enumerate(bodies[:through]):
        place = many.path_after.poses[(k + 1) * len(many.path_after) // 3, :3, 3]
        changed = moved(changed, j, place + np.array([0.0, 0.0, many.map[j].body.size[2] / 2]))
    assessment = with_doubts(changed).summary["assessment"]
    assert assessment["level"] == level
    (told,) = [reason for reason in assessment["reasons"] if "The robot drove through" in reason]
    assert all(f"#{many.map[j].id}" in told for j in bodies[:through])
    assert ("21 objects, 1 of them doubtful." in assessment["reasons"][0]) == (level == "good")
