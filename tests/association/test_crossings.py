"""Two things of one label in front of the point where the rays to both cross."""

from dataclasses import replace

import numpy as np
import pytest
from association_scenes import Scene, watch

from objslam.association.crossings.bundles import second_bundle
from objslam.association.crossings.one_or_two import excess_of, find_crossings
from objslam.association.crossings.usual_views import UsualViews
from objslam.association.landmarks import Landmarks, State
from objslam.association.observations import PosedRays, observe
from objslam.association.visibility import frames_of
from objslam.config import Settings
from objslam.core.arrays import Floats
from objslam.core.geometry import lift_se2

FAR = 9.0  # m, the distance up to which things are detected.
AHEAD, BEYOND = (4.6, -6.0, 0.4), (7.5, 5.2, 0.4)  # The robot drives towards both, in the first and in the last aisle.
BESIDE = [(-3.0, -3.0, 0.5), (-1.0, 3.0, 0.3), (-5.0, -2.2, 0.4), (-6.0, 3.5, 0.35)]


def aisles(step: float = 0.12) -> Floats:
    """Robot poses (K, 4, 4) along three straight aisles, each towards its end."""
    ends = [((-8.0, -6.0), (2.0, -6.0)), ((2.0, 0.0), (-8.0, 0.0)), ((-8.0, 6.0), (2.0, 6.0))]
    poses = []
    for begin, end in ends:
        way = np.subtract(end, begin)
        at = begin + np.linspace(0, 1, int(np.hypot(*way) / step))[:, None] * way
        poses.append(np.column_stack([at, np.full(len(at), np.arctan2(way[1], way[0]))]))
    return lift_se2(np.concatenate(poses))


def hall(seed: int, points: Floats, step: float = 0.12) -> Scene:
    """What a robot in the aisles sees of things of one label at points (N, 3) m that are nearer than `FAR`."""
    scene = watch(points, aisles(step), size=0.5, missed=0.15, pixel_sigma=2.0, seed=seed)
    origins, _ = scene.rays.in_map(scene.keyframes.map_T_camera)
    seen = np.linalg.norm(points[scene.whose] - origins, axis=1) < FAR
    return replace(scene, rays=scene.rays.take(np.flatnonzero(seen)), whose=scene.whose[seen])


def true_state(scene: Scene, joined: dict[int, int]) -> State:
    """The association of a scene by its truth, with landmarks at the points where their rays meet best. joined: things whose
    rays belong to another one."""
    of = PosedRays(scene.rays, scene.keyframes, scene.cameras, scene.keyframes.map_T_camera, scene.rays.sigma)
    obs, ray, order = observe(of)
    whose = scene.whose.copy()
    for thing, other in joined.items():
        whose[whose == thing] = other
    present, matched = np.unique(whose, return_inverse=True)
    place = scene.place(replace(scene.associate(), object=matched, label=np.zeros(len(present), dtype=np.int64)))
    landmarks = Landmarks.new(place, np.ones(len(present)), np.zeros(len(present), dtype=np.int64), 1)
    view = frames_of(scene.keyframes, order, scene.cameras, scene.keyframes.map_T_camera, Settings())
    return State(obs, view, landmarks, matched[ray])


@pytest.mark.parametrize("seed", [0, 1, 3])
def test_no_object_is_where_rays_to_two_things_cross(seed: int) -> None:
    scene = hall(seed, np.array([AHEAD, BEYOND, *BESIDE]))
    association = scene.associate()
    whole = [np.unique(scene.whose[association.object == j]) for j in range(association.count)]
    assert all(len(things) == 1 for things in whole)
    assert {2, 3, 4, 5} <= {int(things[0]) for things in whole}


@pytest.mark.parametrize("solved", [False, True])
def test_crossings_are_told_apart_at_solved_poses_and_not_at_poses_that_drift(solved: bool) -> None:
    """Without a localisation, rays of one thing meet only after a solve."""
    scene = hall(0, np.array([AHEAD, BEYOND, *BESIDE]))
    drifting = replace(scene.keyframes, localized_every=0.0)
    association = scene.associate(keyframes=drifting, solved=solved)
    whole = [np.unique(scene.whose[association.object == j]) for j in range(association.count)]
    assert all(len(things) == 1 for things in whole) == solved


@pytest.mark.parametrize("times", [1.0, 3.0])
def test_rays_better_than_their_nominal_noise_tell_as_much(times: float) -> None:
    """The gains of the other landmarks show the noise of the rays, so the odds hardly depend on the nominal noise."""
    scene = hall(2, np.array([AHEAD, BEYOND, *BESIDE]), step=0.04)
    noisier = replace(scene, rays=replace(scene.rays, sigma=times * scene.rays.sigma))
    found = find_crossings(true_state(noisier, {1: 0}), np.ones(len(scene.rays), dtype=bool), 3)
    assert found.landmark[found.two].tolist() == [0]


def test_gains_count_against_those_of_the_other_landmarks() -> None:
    """Three landmarks of the usual gain are assumed. The quantiles are those of chi-squared with 3 degrees of freedom."""
    rng = np.random.default_rng(0)
    gain = 0.3 * rng.chisquare(3, 400)
    assert excess_of(gain) == pytest.approx(0.3, abs=0.06)
    # A ghost does not count for itself.
    assert excess_of(np.append(gain, 500.0))[-1] == pytest.approx(excess_of(gain).min(), rel=0.05)
    # Errors of a quarter of the landmarks show in the second quantile.
    lasting = np.concatenate([gain[:300], 10 * gain[300:]])
    others = np.sort(np.append(lasting[1:], [2.366] * 3))
    assert excess_of(lasting)[0] == pytest.approx(np.quantile(others, 0.8) / 4.642)


@pytest.mark.parametrize("seed", [2, 3, 4])
def test_odds_tell_one_thing_from_two(seed: int) -> None:
    """Of the landmarks whose rays come in two bundles, only the first has the rays of two things."""
    scene = hall(seed, np.array([AHEAD, BEYOND, *BESIDE]), step=0.04)
    found = find_crossings(true_state(scene, {1: 0}), np.ones(len(scene.rays), dtype=bool), 3)
    assert found.landmark[found.two].tolist() == [0]
    assert len(found.landmark) >= 2
    assert all(np.linalg.norm(found.position[0] - thing, axis=1).min() < 2.5 for thing in (AHEAD, BEYOND))


def test_a_landmark_whose_rays_come_back_is_not_split_again() -> None:
    scene = hall(2, np.array([AHEAD, BEYOND, *BESIDE]), step=0.04)
    state, tries = true_state(scene, {1: 0}), np.zeros(len(scene.rays), dtype=np.int64)
    found = find_crossings(state, np.ones(len(scene.rays), dtype=bool), 3)
    others = state.assigned[state.owner != 0]
    assert found.landmark[found.untried(state, tries)].tolist() == [0]
    assert not tries[others].any()
    assert not found.untried(state, tries).any()
    tries[state.assigned[state.owner == 0][::2]] = 0  # Half of its rays are new.
    assert found.landmark[found.untried(state, tries)].tolist() == [0]


def test_sizes_tell_where_the_two_things_are() -> None:
    """Boxes grow as the robot drives at a thing, which tells its distance. Without sizes, bearings alone split nothing."""
    scene = hall(0, np.array([AHEAD, BEYOND, *BESIDE]))
    state = true_state(scene, {1: 0})
    with_sizes, without = (find_crossings(state, np.full(len(scene.rays), sized), 3) for sized in (True, False))
    assert np.linalg.norm(with_sizes.position[0] - AHEAD, axis=1).min() < 0.3
    assert not len(without.landmark)


def test_two_bundles_are_found_at_the_widest_gap() -> None:
    angle = np.radians([0.0, 1.0, 2.0, 30.0, 31.0, 0.0, 1.0, 2.0])
    direction = np.column_stack([np.cos(angle), np.sin(angle), np.zeros(8)])
    owner = np.array([0, 0, 0, 0, 0, 1, 1, 1])
    second = second_bundle(direction, owner, 2, np.radians(5.0))
    assert second[5:].sum() == 0
    assert {tuple(np.flatnonzero(second[:5])), tuple(np.flatnonzero(~second[:5]))} == {(0, 1, 2), (3, 4)}
    assert second_bundle(direction, owner, 2, np.radians(5.0), fewest=3).sum() == 0


def test_far_odds_count_the_boxes_of_other_landmarks() -> None:
    """A box beyond all others of its class is rare. The boxes of the landmark itself do not count."""
    state = true_state(hall(0, np.array([AHEAD, BEYOND, *BESIDE])), {})
    usual = UsualViews.of(state, np.ones(len(state.obs), dtype=bool))
    distance, landmark = np.array([3.0, 9.0, 11.0, 60.0, 60.0]), np.array([0, 2, 3, 0, 5])
    for away, j, odds in zip(distance, landmark, usual.far_odds(distance, landmark), strict=True):
        others = state.distance[state.owner != j]
        expected = np.log(((others > away / 1.4).sum() + 1) / (0.1 * len(others) + 1))
        assert odds == pytest.approx(min(expected, 0.0))


def test_one_large_thing_that_looks_elsewhere_from_its_other_side_is_one() -> None:
    """Rays from two sides of a thing of 0.5 m miss each other by 0.3 m. Two things would overlap."""
    points = np.array([(5.0, 0.0, 0.3), (5.0, 0.0, 0.6), *BESIDE])
    way = np.column_stack([np.linspace(-3, 3, 50), np.full(50, 3.0), np.zeros(50)])
    scene = watch(points, lift_se2(np.concatenate([way * [1, -1, 1], way])), size=0.5, pixel_sigma=2.0, seed=0)
    kept = np.flatnonzero((scene.whose > 1) | ((scene.rays.keyframe < 50) == (scene.whose == 0)))
    scene = replace(scene, rays=scene.rays.take(kept), whose=scene.whose[kept])
    state = true_state(scene, {1: 0})
    found = find_crossings(state, np.ones(len(kept), dtype=bool), 3)
    assert found.landmark[0] == 0
    assert found.odds[0] > 0
