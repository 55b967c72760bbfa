"""People who walk away from a robot, or towards it. Their rays nearly meet in a point, and only their ranges change."""

from dataclasses import replace

import numpy as np
import pytest
from more_boxes import with_boxes
from test_moving_things import camera_poses

from objslam.config import load_settings
from objslam.core.arrays import Bools, Floats
from objslam.core.camera import project
from objslam.core.diagnostics import Ledger
from objslam.core.geometry import inverse
from objslam.core.types import Log
from objslam.mapping import pipeline
from objslam.mapping.moves.constant_velocity import Sights
from objslam.mapping.moves.receding_things import moving_along
from objslam.simulation import preset, simulate
from objslam.simulation.settings import make_camera

RATE = 4.0
"""Images per second."""
NOISE = 0.03
"""The standard deviation of depths, m."""


def sights(
    places: Floats,
    velocities: Floats,
    boxes: int,
    label: int,
    rng: np.random.Generator,
    *,
    visits: int = 1,
    width: float = 0.45,
) -> Sights:
    """The rays and ranges of things (N, 3) m with velocities (N, 3) m/s. A camera drives past them at 0.6 m/s, on x. Each
    thing is seen for `boxes` images, in which the camera passes it."""
    count = len(places)
    thing = np.repeat(np.arange(count), boxes * visits)
    step = np.tile(np.arange(boxes * visits), count)
    since = (step % boxes - (boxes - 1) / 2) / RATE
    origin = np.column_stack([places[thing, 0] + 0.6 * since, np.zeros(len(thing)), np.full(len(thing), 1.0)])
    to = places[thing] + velocities[thing] * since[:, None] - origin
    distance = np.linalg.norm(to, axis=1)
    seen = to + distance[:, None] * rng.normal(0, 0.004, to.shape)
    return Sights(
        thing=thing,
        time=since + 100.0 * (step // boxes) + 1000.0 * thing,
        origin=origin,
        direction=seen / np.linalg.norm(seen, axis=1)[:, None],
        across=0.008 * distance,
        range=distance + rng.normal(0, NOISE, len(thing)) + rng.normal(0, 0.05, count)[thing],
        nominal=0.03 + 0.02 * distance,
        bias=np.full(len(thing), 0.05),
        half=np.full(len(thing), width / 2) / distance,
        place=places,
        label=np.full(count, label),
    )


def together(*parts: Sights) -> Sights:
    """All things of several parts."""
    first = np.cumsum([0, *(len(one.label) for one in parts)])
    parts = tuple(replace(one, thing=one.thing + n) for one, n in zip(parts, first[:-1], strict=True))
    return Sights(**{name: np.concatenate([getattr(one, name) for one in parts]) for name in vars(parts[0])})


def beside(count: int, rng: np.random.Generator) -> Floats:
    """Places (N, 3) m beside the path."""
    return np.column_stack([10.0 * np.arange(count), rng.uniform(2.5, 4.5, count), rng.uniform(0.5, 1.5, count)])


def shelves(rng: np.random.Generator) -> Sights:
    """Thirty things at rest, of label 0."""
    return sights(beside(30, rng), np.zeros((30, 3)), 8, 0, rng)


def found(*parts: Sights) -> Bools:
    """Which things of the last part move."""
    return moving_along(together(*parts), 0.0)[0][-len(parts[-1].label) :]


def walks(count: int, speed: float) -> Floats:
    """Velocities (N, 3) m/s along the view, half of them towards the robot."""
    return np.array([0.0, speed, 0.0]) * np.where(np.arange(count) % 2, 1.0, -1.0)[:, None]


@pytest.mark.parametrize("boxes", [3, 5, 8, 10])
def test_people_who_walk_along_the_view_move(boxes: int) -> None:
    rng = np.random.default_rng(boxes)
    people = sights(beside(20, rng), walks(20, 1.4), boxes, 1, rng)
    assert found(shelves(rng), people).mean() > 0.9


def test_slow_people_move_if_they_are_seen_for_two_seconds() -> None:
    rng = np.random.default_rng(2)
    assert found(shelves(rng), sights(beside(20, rng), walks(20, 0.5), 9, 1, rng)).all()


@pytest.mark.parametrize("boxes", [3, 5, 8, 10])
def test_things_at_rest_do_not_move(boxes: int) -> None:
    """By noise alone, about one view in 100,000 has such a trend."""
    rng = np.random.default_rng(boxes)
    assert not found(sights(beside(3000, rng), np.zeros((3000, 3)), boxes, 0, rng, width=0.02)).any()


def test_one_wrong_depth_neither_hides_a_person_nor_makes_one() -> None:
    rng = np.random.default_rng(4)
    others, people = shelves(rng), sights(beside(20, rng), walks(20, 0.8), 8, 1, rng)
    posts = sights(beside(20, rng), np.zeros((20, 3)), 4, 2, rng)
    for one in (people, posts):
        one.range[rng.integers(0, 4, 20) + np.flatnonzero(np.diff(one.thing, prepend=-1))] -= 1.2  # Somebody is in front.
    both = found(others, together(people, posts))
    assert both[:20].mean() > 0.9
    assert not both[20:].any()


def test_things_that_a_camera_sees_through_do_not_move() -> None:
    """Their depths end at the thing or behind it, at random, or first here and then there."""
    rng = np.random.default_rng(5)
    tables, racks = (sights(beside(40, rng), np.zeros((40, 3)), 6, label, rng) for label in (1, 2))
    tables.range[:] += rng.uniform(0, 1.5, len(tables.range)) * (rng.random(len(tables.range)) < 0.6)
    after = np.arange(len(racks.range)) % 6 >= np.repeat(rng.integers(0, 7, 40), 6)
    racks.range[after] += np.repeat(rng.uniform(0.5, 2.0, 40), 6)[after]
    both = found(shelves(rng), together(tables, racks))
    assert both.mean() < 0.03


def test_a_thing_that_rests_at_its_place_on_another_visit_does_not_move() -> None:
    """A sign that is seen from the side: its depths pass from its near edge to its middle, as the robot drives past."""
    rng = np.random.default_rng(6)
    signs = sights(beside(6, rng), np.zeros((6, 3)), 7, 1, rng, visits=3, width=0.15)
    signs.range[:] += 0.25 * np.linspace(-0.5, 0.5, 7)[np.arange(len(signs.range)) % 7]
    assert not found(shelves(rng), signs).any()


RING = np.linspace(0, 2 * np.pi, 12, endpoint=False)
BODY = np.array([[0.2 * np.cos(a), 0.2 * np.sin(a), z] for a in RING for z in (0.0, 0.85, 1.7)])
"""Points on the surface of a person, 0.4 m wide and 1.7 m tall, around the place on the floor."""


def with_people(log: Log) -> Log:
    """The log with a person every 20 s, who walks for 1.4 s along the view, 0.5 m/s away from the robot."""
    camera, stamps, poses = camera_poses(log)
    rng, rows = np.random.default_rng(0), []
    for begin in np.arange(stamps[0] + 5.0, stamps[-1] - 1.4, 20.0):
        shown = np.flatnonzero((stamps >= begin) & (stamps <= begin + 1.4))
        middle = poses[shown[len(shown) // 2]] @ camera.base_T_camera
        ahead = middle[:2, 2] / np.hypot(*middle[:2, 2])
        since = stamps[shown] - stamps[shown].mean()
        for frame, at in zip(shown, middle[:2, 3] + ahead * (3.2 + 0.5 * since[:, None]), strict=True):
            camera_T_map = inverse(poses[frame] @ camera.base_T_camera)
            body = (BODY + np.append(at, 0.0)) @ camera_T_map[:3, :3].T + camera_T_map[:3, 3]
            if body[:, 2].min() < 0.5:
                continue
            pixels = project(camera, body)
            low, high = pixels.min(axis=0), pixels.max(axis=0)
            if (low > 1).all() and (high < [camera.width - 2, camera.height - 2]).all():
                box = np.concatenate([low, high]) + rng.normal(0, 1.5, 4)
                rows.append((frame, *box, body[:, 2].min() + rng.normal(0, NOISE)))
    table = np.array(rows)
    more = with_boxes(log, table[:, 0].astype(np.int64), table[:, 1:5], "person")
    found = more.cameras[0].detections
    assert found is not None
    depths = found.depths.copy()
    depths[found.label == found.label_names.index("person")] = table[:, 5]
    return replace(more, cameras=(replace(more.cameras[0], detections=replace(found, depths=depths)),))


@pytest.mark.parametrize("mode", ["fixed", "joint"])
def test_a_map_has_no_people_who_walk(mode: str) -> None:
    """Of three people, one or two were objects, with sigmas of 0.1 m."""
    left = make_camera("left", focal=380.0, position=(0.0, 0.0, 0.8), yaw=np.pi / 2)
    noise = {"sigma": NOISE, "sigma_per_m": 0.0}
    log = with_people(simulate(preset("rooms", cameras=(left,), missed=0.1, false=0.0, depth=noise), 1))
    result = pipeline.run(log, load_settings(None, (f"mode={mode}", "checks.use=false", "output.recording=false")), Ledger())
    labels = [one.label for one in result.map.objects]
    assert (labels.count("person"), len(labels)) == (0, 15)
    assert [one.reason for one in result.doubts if one.label == "person"] == ["moves"]
