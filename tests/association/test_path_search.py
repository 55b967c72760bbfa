"""The most likely path: visits that were matched one post aside come back, and copies of posts lose their rays."""

from dataclasses import replace

import numpy as np
import pytest

from objslam.association.path_search import state_grid, viterbi
from objslam.association.path_search.most_likely_path import PathSearch
from objslam.core.geometry import inverse, lift_se2
from objslam.core.types import Keyframes, Rays

BASE_T_CAMERA = np.array([[0.0, 0.0, 1.0, 0.0], [-1.0, 0.0, 0.0, 0.0], [0.0, -1.0, 0.0, 0.3], [0.0, 0.0, 0.0, 1.0]])
TURN, RANGE = 0.006, 0.05  # rad, m: the noise of the rays
YAW_STEP, STEP = 0.01, 0.01  # rad, m: the noise of the odometry from keyframe to keyframe


def rows_of_posts():
    """Four rows of three posts, 0.25 m apart, around a room of 6 x 6 m: (12, 3) m."""
    row = np.array([[0.0, -0.25], [0.0, 0.0], [0.0, 0.25]])
    places = []
    for angle in np.arange(4) * np.pi / 2:
        turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
        places.append((row + np.array([3.0, 0.0])) @ turn.T)
    return np.column_stack([np.concatenate(places), np.full(12, 0.3)])


def drive(rng, posts, ranges=True, labels=1):
    """Return true poses (K, 4, 4) of a robot that turns three times, its keyframes, its rays, and the post of each ray."""
    count = 144
    yaw = np.linspace(0.0, 6 * np.pi, count)
    place = 0.3 * np.column_stack([np.cos(yaw / 3), np.sin(yaw / 3)])
    true = lift_se2(np.column_stack([place, yaw]))
    noise = rng.normal(0, 1, (count - 1, 3)) * [STEP, STEP, YAW_STEP]
    steps = inverse(true[:-1]) @ true[1:] @ lift_se2(noise)
    odometry = [true[0]]
    for step in steps:
        odometry.append(odometry[-1] @ step)
    variance = np.zeros((count, 6, 6))
    variance[:, [2, 3, 4], [2, 3, 4]] = np.arange(count)[:, None] * np.array([YAW_STEP, STEP, STEP]) ** 2
    none = np.zeros(count, dtype=np.int64)
    keyframes = Keyframes(
        np.arange(count, dtype=float),
        none,
        np.arange(count),
        np.broadcast_to(BASE_T_CAMERA, (count, 4, 4)),
        np.stack(odometry),
        odom_T_base=np.stack(odometry),
        drift=variance,
    )
    poses = true @ BASE_T_CAMERA
    local = np.einsum("kji,knj->kni", poses[:, :3, :3], posts - poses[:, None, :3, 3])
    seen, whose = np.nonzero(local[..., 2] > 0.8 * np.linalg.norm(local, axis=2))
    to = local[seen, whose]
    distance = np.linalg.norm(to, axis=1)
    direction = to / distance[:, None] + rng.normal(0, TURN, to.shape)
    size = len(seen)
    rays = Rays(
        keyframe=seen,
        direction=direction / np.linalg.norm(direction, axis=1, keepdims=True),
        sigma=np.full(size, TURN),
        range=distance + rng.normal(0, RANGE, size) if ranges else np.full(size, np.nan),
        range_sigma=np.full(size, RANGE),
        range_bias=np.zeros(size),
        label=whose % labels,
        score=np.ones(size),
        box=np.zeros((size, 4)),
        track_id=np.full(size, -1),
        label_names=tuple(f"post {i}" for i in range(labels)),
    )
    return true, keyframes, rays, whose


def most_likely_path(*given):
    """The most likely path through a map, None if there is nothing to search."""
    search = PathSearch.of(*given)
    return None if search is None else search.path()


def one_post_aside(true):
    """The path, of which the second round is turned by the angle between two posts."""
    wrong = true.copy()
    second = slice(len(true) // 3, 2 * len(true) // 3)
    wrong[second] = lift_se2(np.array([0.0, 0.0, np.arctan2(0.25, 3.0)])) @ true[second]
    return wrong


def right(rays, poses, posts, whose):
    """Return the share of rays to which their own post is the nearest."""
    origins, directions = rays.in_map(poses @ BASE_T_CAMERA)
    to = posts - origins[:, None]
    off = np.linalg.norm(np.cross(to, directions[:, None]), axis=2) + 10.0 * (np.einsum("rnk,rk->rn", to, directions) < 0)
    return (off.argmin(axis=1) == whose).mean()


@pytest.mark.parametrize("ranges", [True, False])
@pytest.mark.parametrize("seed", range(2))
def test_a_visit_one_post_aside_comes_back(seed, ranges):
    posts = rows_of_posts()
    true, keyframes, rays, whose = drive(np.random.default_rng(seed), posts, ranges)
    wrong = one_post_aside(true)
    found = most_likely_path(keyframes, rays, wrong, posts, np.zeros(12, dtype=np.int64), np.ones(12))
    assert right(rays, wrong, posts, whose) < 0.8
    assert right(rays, found.map_T_base, posts, whose) > 0.98
    left = inverse(true) @ found.map_T_base
    assert np.median(np.abs(np.arctan2(left[:, 1, 0], left[:, 0, 0]))) < 2 * found.turn
    assert np.median(np.linalg.norm(left[:, :2, 3], axis=1)) < 2 * found.shift


def test_copies_of_posts_that_are_rarely_detected_lose_their_rays():
    """A wrong visit has made copies of all posts, which explain it without any deviation."""
    posts = rows_of_posts()
    true, keyframes, rays, whose = drive(np.random.default_rng(0), posts)
    wrong = lift_se2(np.array([0.0, 0.0, 0.04])) @ true
    wrong = np.where((np.arange(len(true)) % 48 < 8)[:, None, None], wrong, true)  # Eight keyframes of each round.
    copies = posts @ lift_se2(np.array([0.0, 0.0, 0.04]))[:3, :3].T
    both, label = np.concatenate([posts, copies]), np.zeros(24, dtype=np.int64)
    assert right(rays, wrong, both, whose) < 0.9
    found = most_likely_path(keyframes, rays, wrong, both, label, np.repeat([0.9, 0.1], 12))
    assert right(rays, found.map_T_base, both, whose) > 0.98
    equal = most_likely_path(keyframes, rays, wrong, both, label, np.ones(24))
    assert right(rays, equal.map_T_base, both, whose) < right(rays, found.map_T_base, both, whose)


def test_a_ray_belongs_to_a_landmark_of_its_label():
    posts = rows_of_posts()
    true, keyframes, rays, whose = drive(np.random.default_rng(0), posts, labels=3)
    wrong, ones = one_post_aside(true), np.ones(12)
    found = most_likely_path(keyframes, rays, wrong, posts, np.arange(12) % 3, ones)
    assert right(rays, found.map_T_base, posts, whose) > 0.98
    swapped = most_likely_path(keyframes, rays, wrong, posts, (np.arange(12) + 1) % 3, ones)
    assert right(rays, swapped.map_T_base, posts, whose) < 0.5


def test_without_two_landmarks_of_a_label_there_is_nothing_to_search():
    posts = rows_of_posts()
    true, keyframes, rays, _ = drive(np.random.default_rng(0), posts, labels=12)
    assert most_likely_path(keyframes, rays, true, posts, np.arange(12), np.ones(12)) is None
    lost = np.where(np.arange(12)[:, None] > 0, np.nan, posts)
    assert most_likely_path(keyframes, rays, true, lost, np.zeros(12, dtype=np.int64), np.ones(12)) is None


@pytest.mark.parametrize("ranges", [True, False])
def test_a_landmark_that_is_not_there_attracts_no_ray_of_its_stretches(ranges):
    """Against a search in which this landmark has another label in these stretches, so that no ray can belong to it."""
    rng = np.random.default_rng(0)
    posts = rows_of_posts()
    true, keyframes, rays, whose = drive(rng, posts, ranges)
    posts = np.concatenate([posts, rng.uniform([-6, -6, 0], [6, 6, 2], (6, 3)), [[1.0, 1.0, 1.0]]])
    wrong, rate = one_post_aside(true), np.append(rng.uniform(0.3, 1.0, 18), 0.0)
    search = PathSearch.of(keyframes, rays, wrong, posts, np.zeros(19, dtype=np.int64), rate)
    whole, nothing = search.path().map_T_base, np.zeros(len(rays), dtype=bool)
    for j in (0, 18):  # The last one is not in the search.
        np.testing.assert_allclose(search.path_without(j, nothing).map_T_base, whole, atol=1e-9)
    moved = 0
    for j in range(0, 12, 3):
        mine = whose == j
        elsewhere = replace(search.landmarks, label=np.where(np.arange(18) == j, 1, 0))
        costs, others = (list(search.sight.costs(map_of)) for map_of in (search.landmarks, elsewhere))
        stretches = np.unique(search.sight.stretch[mine])
        for k in stretches.tolist():
            costs[k] = others[k]
        best = viterbi.most_likely_states(search._motions, iter(costs), search.sight.grid)
        found = search.path_without(j, mine).map_T_base[search.middle] @ inverse(wrong[search.middle])
        assert (np.abs(np.arctan2(found[:, 1, 0], found[:, 0, 0]) - best[:, 2]) < 1e-9).mean() > 0.98  # Costs are rounded.
        moved += np.abs(search.path_without(j, mine).map_T_base - whole).max() > 1e-3
    assert moved >= 2


def test_rays_taken_in_parts_give_the_same_path(monkeypatch):
    posts = rows_of_posts()
    true, keyframes, rays, _ = drive(np.random.default_rng(1), posts)
    ask = keyframes, rays, one_post_aside(true), posts, np.zeros(12, dtype=np.int64), np.ones(12)
    whole = most_likely_path(*ask)
    monkeypatch.setattr("objslam.association.path_search.ray_costs._RAYS_AT_ONCE", 7)
    np.testing.assert_array_equal(most_likely_path(*ask).map_T_base, whole.map_T_base)


@pytest.mark.parametrize("drift", [0.3, 1.0, 4.0, 20.0])
def test_states_are_the_best_of_all_sequences_of_states(drift, monkeypatch):
    """Against the total costs of all pairs of states, motion after motion. Steps reach the edges of the grid, and with the
    largest drift some motions leave it from all states."""
    monkeypatch.setattr(state_grid, "_SHIFTS", 2)
    monkeypatch.setattr(state_grid, "_TURNS", 1)
    grid, rng, count = state_grid.Grid(0.1, 0.05), np.random.default_rng(0), 40
    unit = np.array([grid.shift, grid.shift, grid.turn])
    motions = viterbi.Motions(
        error=rng.normal(size=(count - 1, 3)) * drift * unit,
        variance=(rng.uniform(0.6, 1 + drift, (count - 1, 3)) * unit) ** 2,
        way=rng.normal(size=(count - 1, 2)),
    )
    seen = rng.uniform(0, 12, (count, 3, 5, 5)).astype(np.float32)
    turn, x, y = (a.ravel() for a in np.meshgrid(grid.turns, grid.shifts, grid.shifts, indexing="ij"))
    cos, sin = np.cos(turn) - 1, np.sin(turn)
    total, paths = seen[0].ravel().astype(np.float64), [[i] for i in range(75)]
    for k in range(count - 1):
        by_x = x - x[:, None] - (cos * motions.way[k, 0] - sin * motions.way[k, 1])[:, None] + motions.error[k, 0]
        by_y = y - y[:, None] - (sin * motions.way[k, 0] + cos * motions.way[k, 1])[:, None] + motions.error[k, 1]
        by_turn = turn - turn[:, None] + motions.error[k, 2]
        moving = sum(off**2 / motions.variance[k, i] for i, off in enumerate((by_x, by_y, by_turn)))
        slipped = np.full_like(total, total.min() + 20.0)  # From the best state, a motion costs at most a slip.
        sums = total[:, None] + moving
        before = np.where(sums.min(axis=0) <= slipped, sums.argmin(axis=0), total.argmin())
        total = np.minimum(sums.min(axis=0), slipped) + seen[k + 1].ravel()
        paths = [[*paths[i], j] for j, i in enumerate(before)]
    best = np.array(paths[int(total.argmin())])
    found = viterbi.most_likely_states(motions, iter(seen), grid)
    expected = np.column_stack([x[best], y[best], turn[best]])
    assert (np.abs(found - expected).max(axis=1) < 1e-9).mean() > 0.9  # Totals are stored in one byte each.
