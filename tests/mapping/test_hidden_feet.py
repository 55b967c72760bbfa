"""Posts of one label. Something without a box hides the foot of one of them from everywhere."""

import numpy as np
import pytest
from mapping.hiding_drives import Solid, hiding_drive

from objslam.config import load_settings
from objslam.core.bodies.body import Body
from objslam.core.diagnostics import Ledger
from objslam.core.object_map import MapObject
from objslam.mapping import pipeline
from objslam.mapping.bodies.hidden_feet import with_hidden_feet

HEIGHT, WALL = 2.0, 1.0  # m, of the posts, and of the wall before one of them.


def ring(hidden):
    """Six posts around the drive. hidden: whether a wall stands before the first."""
    posts = []
    for turn in np.linspace(0, 2 * np.pi, 6, endpoint=False):
        at = 4.0 * np.array([np.cos(turn), np.sin(turn)])
        posts.append(Solid("cylinder", "post", np.array([*at, HEIGHT / 2]), np.array([0.1, 0.1, HEIGHT / 2]), 0.0))
    wall = Solid("cuboid", None, np.array([3.6, 0.0, WALL / 2]), np.array([0.05, 2.0, WALL / 2]), 0.0)
    return [*posts, wall] if hidden else posts


@pytest.mark.parametrize("hidden", [False, True])
def test_a_post_behind_a_wall_has_an_honest_height(hidden):
    """The rays through its visible half meet half a metre above its centre."""
    log = hiding_drive(1, solids=ring(hidden), frames=300)
    found = pipeline.run(log, load_settings(None, ("output.recording=false",)), Ledger()).map.objects
    found = [one for one in found if one.status == "ok"]
    assert len(found) >= 5
    first = min(found, key=lambda one: np.linalg.norm(one.position[:2] - [4.0, 0.0]))
    assert first.position[2] - HEIGHT / 2 == pytest.approx(WALL / 2 if hidden else 0.0, abs=0.12)
    sigmas = {one.id: np.sqrt(one.covariance[2, 2]) for one in found}
    assert sigmas.pop(first.id) == pytest.approx(WALL / 2, abs=0.12) if hidden else sigmas[first.id] < 0.1
    assert max(sigmas.values()) < 0.1


def a_map(rows, label="post"):
    """Objects with heights and feet (n, 2), m, which are known to 5 cm."""
    return tuple(
        MapObject(
            j, label, np.array([float(j), 0.0, foot + height / 2]), 0.01 * np.eye(3), "ok", 9, 9, 60.0, 0.1, 0.0, 1.0,
            body=Body("cylinder", np.array([0.2, 0.2, height]), 0.0, np.full(3, 0.05), 1.0),
        )
        for j, (height, foot) in enumerate(rows)
    )  # fmt: skip


POSTS = [(5.0, 0.0), (5.1, -0.05), (4.9, 0.05), (5.05, 0.0)]


@pytest.mark.parametrize(
    ("rows", "missing"),
    [
        ([*POSTS, (2.5, 2.5)], 2.5),  # Its upper half.
        ([*POSTS, (3.5, 1.2)], 1.5),
        ([*POSTS, (2.5, 0.0)], 0.0),  # A short post that stands on the ground.
        ([*POSTS, (5.0, 1.0)], 0.0),  # A whole post on a wall.
        ([*POSTS, (4.8, 0.2)], 0.0),  # As much as the others differ.
        ([*POSTS[:2], (2.5, 2.5)], 0.0),  # Two posts do not show how high posts are.
        ([(5.0, 0.0), (1.0, 0.0), (3.0, 0.0), (2.0, 0.1), (1.0, 1.5)], 0.0),  # Things of all heights.
        ([(0.2, 0.0), (0.2, 0.7), (0.21, 1.4), (0.2, 0.9), (0.1, 1.5)], 0.0),  # Cups on tables and shelves.
    ],
)
def test_what_may_be_missing_at_the_foot(rows, missing):
    before = a_map(rows)
    after = with_hidden_feet(before)
    expected = [0.0] * (len(rows) - 1) + [missing]
    assert [np.sqrt(o.covariance[2, 2] - 0.01) for o in after] == pytest.approx([m / 2 for m in expected], abs=0.05)
    assert [o.body.size_sigma[2] for o in after] == pytest.approx([np.hypot(0.05, m) for m in expected], abs=0.05)
    assert [o.covariance[0, 0] for o in after] == [0.01] * len(rows)
    assert [o.position is p.position for o, p in zip(after, before, strict=True)] == [True] * len(rows)


def test_most_feet_may_be_hidden():
    """Chairs behind desks: all end at the same height, and a few show their feet."""
    feet = [0.01, 0.02, 0.05, 0.1, 0.27, 0.24, 0.42, 0.62, 0.54, 0.4]
    after = with_hidden_feet(a_map([(0.84 - foot, foot) for foot in feet], "chair"))
    expected = [(foot - 0.05) / 2 if foot > 0.2 else 0.0 for foot in feet]
    assert [np.sqrt(o.covariance[2, 2] - 0.01) for o in after] == pytest.approx(expected, abs=0.05)


def test_other_labels_show_nothing():
    posts, other = a_map(POSTS), a_map([(2.5, 2.5)], "lamp")
    assert with_hidden_feet((*posts, *other))[-1] is other[0]
