"""Two things of one label side by side, and the two points beside them where the rays to both cross."""

from dataclasses import replace

import numpy as np
import pytest
from association_scenes import Scene, watch

from objslam.association.crossings import ghost_pairs
from objslam.core.arrays import Floats
from objslam.core.geometry import angles_off, lift_se2
from objslam.core.types import Association

THINGS = np.array([[0.1, 0.1, 0.3], [-0.1, -0.1, 0.3]])
GHOSTS = np.array([[0.1, -0.1, 0.3], [-0.1, 0.1, 0.3]])  # Where the rays from the west and from the south cross.
OTHERS = np.array([[0.2, 3.0, 0.3], [3.0, 0.4, 0.3], [2.5, 2.5, 0.3]])


def look(side: float, count: int) -> Floats:
    """Robot poses (count, 4, 4) on a short way, 3 m from the origin, that look at it in the direction `side`, rad."""
    across = np.linspace(-0.4, 0.4, count)
    x, y = -3 * np.cos(side) - across * np.sin(side), -3 * np.sin(side) + across * np.cos(side)
    return lift_se2(np.column_stack([x, y, np.full(count, side)]))


def scene(seed: int, last: int) -> Scene:
    """What a robot sees from the west, from the south, and in `last` frames from the south-west."""
    ways = [look(0.0, 60), look(np.pi / 2, 60), look(np.pi / 4, last)]
    seen = watch(np.concatenate([THINGS, OTHERS]), np.concatenate(ways), missed=0.1, pixel_sigma=1.5, seed=seed)
    points = tuple(replace(camera, sees_size=False) for camera in seen.cameras)
    wide = replace(seen.rays, sigma=6 * seen.rays.sigma)  # As with poses that may err by a degree.
    return replace(seen, rays=wide, cameras=points)


def guess(scene: Scene, points: Floats) -> tuple[Association, Floats]:
    """The association of each ray with the nearest of the points (N, 3), all of one label."""
    origins, directions = scene.rays.in_map(scene.keyframes.map_T_camera)
    off = np.stack([angles_off(origins, directions, np.broadcast_to(p, origins.shape)) for p in points])
    return Association(off.argmin(axis=0), np.zeros(len(points), dtype=np.int64)), points


@pytest.mark.parametrize("seed", range(4))
def test_ghosts_give_way_to_the_things(seed: int) -> None:
    """The rays from the third side decide, though few. Without them, both explanations fit all rays."""
    seen = scene(seed, last=20)
    association = seen.associate(guess=guess(seen, np.concatenate([GHOSTS, OTHERS])))
    found, true, error = seen.compare(association, radius=0.3)
    assert association.count == len(found) == 5
    assert set(true) == set(range(5))
    assert error[true < 2].max() < 0.03


@pytest.mark.parametrize("seed", range(4))
def test_things_stay(seed: int) -> None:
    """A right association stays as it is, also where rays from two sides alone would allow the ghosts."""
    for last in (0, 20):
        seen = scene(seed, last)
        truth = seen.associate(guess=guess(seen, seen.points))
        found, true, error = seen.compare(truth, radius=0.3)
        assert truth.count == len(found) == 5
        assert set(true) == set(range(5))
        assert error[true < 2].max() < 0.03


def test_the_names_of_ghosts_do_not_matter() -> None:
    """A map does not depend on the order of the guess."""
    seen = scene(0, last=20)
    association, points = guess(seen, np.concatenate([GHOSTS, OTHERS]))
    first = seen.associate(guess=(association, points))
    turned = replace(association, object=len(points) - 1 - association.object)
    second = seen.associate(guess=(turned, points[::-1].copy()))
    np.testing.assert_array_equal(first.object, second.object)


@pytest.mark.parametrize("seed", range(4))
def test_no_rays_of_a_pair_are_tried_twice(seed: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """The ghosts are replaced, so all pairs that still fit badly come again."""
    seen, tried, of = scene(seed, last=20), list[bytes](), ghost_pairs._best_points

    def noted(obs, *more):
        tried.append(obs.direction.tobytes())
        return of(obs, *more)

    monkeypatch.setattr(ghost_pairs, "_best_points", noted)
    monkeypatch.setattr(ghost_pairs, "_LEAST_GAIN", 0.0)  # Every pair that fits a little worse than usual is tried.
    seen.associate(guess=guess(seen, np.concatenate([GHOSTS, OTHERS])))
    assert tried
    assert len(set(tried)) == len(tried)
