"""Objects from few rays: found where strays are rare, refused where they are dense or where all looks are one."""

from dataclasses import replace

import numpy as np
import pytest
from association_scenes import drive, join, rays_of_boxes, watch
from scipy.stats import multivariate_normal, norm

from objslam.association.existence import detection_rates
from objslam.association.few_rays.additional_objects import add_few_ray_objects, few_ray_evidence
from objslam.association.few_rays.chance import Strays, _Density, _looks, _smoothed, chance_odds, log_volume, ray_odds
from objslam.association.landmarks import Landmarks, State
from objslam.association.observations import PosedRays, observe
from objslam.association.visibility import frames_of
from objslam.config import Settings
from objslam.core.geometry import lift_se2
from objslam.core.types import Association
from objslam.simulation import preset

POINT = np.array([[0.1, 0.0, 0.4]])


def around(angles, radius=2.0):
    """Robot poses on a circle about the origin at some angles (n,) in degrees, looking at its middle."""
    angle = np.radians(angles)
    return lift_se2(np.column_stack([radius * np.cos(angle), radius * np.sin(angle), angle + np.pi]))


def nothing(rays):
    return Association(np.full(len(rays), -1), np.zeros(0, dtype=np.int64), existence=np.zeros(0))


def posed(scene, rays):
    return PosedRays(rays, scene.keyframes, scene.cameras, scene.keyframes.map_T_camera, rays.sigma)


def search(scene, association=None, positions=None, rays=None, settings=None):
    rays = scene.rays if rays is None else rays
    return add_few_ray_objects(
        posed(scene, rays),
        settings or Settings(),
        nothing(rays) if association is None else association,
        np.zeros((0, 3)) if positions is None else positions,
    )


def stray(scene, count, frames, seed=0):
    """Boxes anywhere in the images."""
    rng = np.random.default_rng(seed)
    centre = rng.uniform([12, 12], [627, 467], (count, 2))
    frame, label = np.sort(rng.integers(0, frames, count)), np.zeros(count, dtype=np.int64)
    return rays_of_boxes(frame, np.hstack([centre - 6, centre + 6]), label, scene.cameras[0], ("cup",))


def state_of(scene, points=POINT):
    obs, _, order = observe(posed(scene, scene.rays))
    view = frames_of(scene.keyframes, order, scene.cameras, scene.keyframes.map_T_camera, Settings())
    landmarks = Landmarks.new(points, np.ones(len(points)), np.zeros(len(points), dtype=np.int64), 1)
    return State(obs, view, landmarks, scene.whose)


def test_two_rays_are_an_object_where_strays_are_rare_and_none_where_they_are_dense():
    pair = watch(POINT, around([0, 60]))
    found = search(pair)
    assert found.count == 1
    assert (found.object == 0).all()
    assert found.few_rays.all()
    assert 0.5 <= found.existence[0] < 0.99  # Two rays are no proof.
    assert pair.associate().count == 0
    crowd = join(pair.rays, stray(pair, 4000, 2))
    assert search(pair, rays=crowd).count == 0


def test_the_evidence_counts_the_rays_that_meet_and_the_frames_that_miss():
    def found(scene, rays):
        return few_ray_evidence(posed(scene, rays), Settings())

    two, five = (watch(POINT, around(np.arange(n) * 60)) for n in (2, 5))
    few, more = found(two, two.rays), found(five, five.rays)
    assert few.explained == more.explained == 1.0
    assert more.chance > few.chance + 5.0 > 5.0
    crowd = found(two, join(two.rays, stray(two, 4000, 2)))
    assert (crowd.chance, crowd.detections, crowd.explained) == (0.0, 0.0, 0.0)
    beside = watch(POINT, around(np.arange(5) * 15))  # An object need not be seen from its other side.
    assert found(beside, beside.rays.take(np.array([0, 4]))).detections < few.detections - 1.0
    assert (more.owner == 0).all()
    np.testing.assert_allclose(more.positions, POINT, atol=0.05)


def test_one_ray_with_a_range_that_another_ray_meets_is_surer_than_two_bearings():
    pair = watch(POINT, around([0, 60]))
    origins, directions = pair.rays.in_map(pair.keyframes.map_T_camera)
    away = np.einsum("ri,ri->r", POINT - origins, directions)
    ranged = replace(pair.rays, range=away, range_sigma=np.full(2, 0.05))
    assert search(pair, rays=ranged).existence[0] > search(pair).existence[0]
    wrong = replace(pair.rays, range=away * [3.0, 0.3], range_sigma=np.full(2, 0.05))
    assert search(pair, rays=wrong).count != 1


def test_strays_alone_give_next_to_nothing():
    """Among boxes at random pixels there is no object. The search may rarely believe in one."""
    found = 0
    for seed in range(8):
        scene = watch(POINT, around(np.arange(0, 360, 18.0)))
        found += search(scene, rays=stray(scene, 60, 20, seed)).count
    assert found <= 4


def test_looks_count_by_parallax_and_not_by_time():
    """Ten images from nearly one place are one look, ten images from around are ten, however soon they follow."""
    near, apart = watch(POINT, around(np.linspace(0, 0.5, 10))), watch(POINT, around(np.arange(0, 360, 36.0)))
    soon = replace(apart, keyframes=replace(apart.keyframes, stamps=np.arange(10) * 1e-3))
    assert _looks(state_of(near))[0] == pytest.approx(1.0, abs=0.5)
    assert _looks(state_of(apart))[0] == pytest.approx(10.0)
    assert (_looks(state_of(soon)) == _looks(state_of(apart))).all()


def test_a_repeated_mistake_is_no_object():
    """The detector makes one mistake in 30 images from nearly one place, and others elsewhere."""
    poses = np.concatenate([around(np.linspace(0, 2.2, 30)), around(np.linspace(60, 300, 30))])
    scene = watch(POINT, poses)
    mine = scene.rays.take(scene.rays.keyframe < 30)
    more = stray(scene, 60, 60)
    rays = join(mine, more)
    once = search(scene, rays=rays)
    state = state_of(replace(scene, rays=mine, whose=np.zeros(len(mine), dtype=np.int64)))
    assert _looks(state)[0] <= 2.5
    assert once.count == 0 or once.existence.max() < 0.9


def test_the_objects_of_the_global_association_stay_as_they_are():
    scene = drive(preset("rooms"), 0)
    before = scene.associate()
    after = search(scene, before, scene.place(before))
    held = before.object >= 0
    assert (after.object[held] == before.object[held]).all()
    assert (after.label[: before.count] == before.label).all()
    assert (after.existence[: before.count] == before.existence).all()
    assert not after.few_rays[: before.count].any()
    assert after.few_rays[before.count :].all()
    assert len(after.label_weights) == after.count
    refused = replace(before, refuted=np.ones(len(scene.rays), dtype=bool))
    assert search(scene, refused, scene.place(before)).count == before.count


def test_the_density_of_boxes_is_a_density():
    rng = np.random.default_rng(0)
    x, label = np.append(rng.normal(0, 0.1, 500), rng.uniform(-1, 1, 20)), np.repeat([0, 1], [500, 20])
    density = _Density.of(x, label, 2, np.array([0.02, 0.02]), 1.0)
    at = np.linspace(-1.2, 1.2, 4001)
    for one in (0, 1):
        value = density.at(at, np.full(len(at), one))
        assert np.trapezoid(value, at) == pytest.approx(1.0, abs=0.02)
    assert density.at(np.zeros(1), np.zeros(1, dtype=np.int64))[0] == pytest.approx(norm(0, 0.1).pdf(0.0), rel=0.2)
    assert density.at(np.array([9.0]), np.zeros(1, dtype=np.int64))[0] < 1e-3


def test_smoothing_is_that_of_scipy():
    from scipy.ndimage import gaussian_filter1d

    counts = np.random.default_rng(0).poisson(1.0, 256)
    assert _smoothed(counts, 3.3) == pytest.approx(gaussian_filter1d(counts.astype(float), 3.3, mode="nearest"), abs=1e-3)


def test_the_odds_of_a_ray_are_a_ratio_of_densities():
    """Against the density of the offset on the plane across the ray, and the density of strays on the same plane."""
    state = state_of(watch(POINT, around(np.arange(0, 360, 30.0))))
    strays = Strays.of(state.obs, state.view, 1)
    off, distance = 0.003, state.distance
    odds, density = ray_odds(state.obs, strays, 5.0, np.full(len(distance), off**2), distance, 1.0, 13.8)
    for i in range(len(distance)):
        spread = (state.obs.sigma[i] * distance[i]) ** 2
        fit = multivariate_normal(np.zeros(2), spread * np.eye(2)).pdf([off, 0.0])
        chance = 5.0 / len(state.view.camera) * strays.image[i] / distance[i] ** 2
        assert density[i] == pytest.approx(chance)
        assert odds[i] == pytest.approx(np.log(fit / chance))


def test_the_volume_of_a_position_is_that_of_its_normal_density():
    """A normal density is 1 over its volume at its peak."""
    covariance = np.diag([0.1, 0.2, 0.4]) ** 2
    peak = multivariate_normal(np.zeros(3), covariance).pdf(np.zeros(3))
    assert log_volume(np.linalg.inv(covariance)[None], np.array([9.0]))[0] == pytest.approx(-np.log(peak))


def test_more_looks_and_fewer_strays_are_less_like_chance():
    scene = watch(POINT, around(np.arange(0, 360, 30.0)))
    odds = []
    for count, strays in ((2, 0), (4, 0), (4, 400)):
        some = np.isin(scene.rays.keyframe, np.arange(count))
        rays = scene.rays.take(some) if not strays else join(scene.rays.take(some), stray(scene, strays, 12))
        obs, _, _ = observe(posed(scene, rays))
        state = state_of(scene)
        true = np.linalg.norm(np.cross(POINT - obs.origin, obs.direction), axis=1) < 0.02
        state = replace(state, obs=obs, matched=np.where(true & (obs.frame < count), 0, -1))
        rates = detection_rates(state.history, state.label, 1)
        odds.append(chance_odds(state, 13.8, Strays.of(obs, state.view, 1), rates)[0])
    assert odds[0] < odds[1]
    assert odds[2] < odds[1]
