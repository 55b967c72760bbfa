"""The search for points that rays agree on, and their refinement, against direct formulas."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from association_scenes import passed_row, rays_of_boxes, watch
from scipy.optimize import least_squares

from objslam.association.hypothesis_search import Search, _Scorer, discover, ranged_by_size
from objslam.association.observations import PosedRays, closest_approach, observe
from objslam.association.refinement import refine
from objslam.core.array_module import as_numpy
from objslam.core.geometry import lift_se2

SEARCH = Search(hypotheses=256, support=3.0, gate=13.8, parallax=np.radians(2), device="cpu")


def circle(count, radius=2.0):
    angle = np.linspace(0, 2 * np.pi, count, endpoint=False)
    return lift_se2(np.column_stack([radius * np.cos(angle), radius * np.sin(angle), angle + np.pi]))


def observed(scene, rays=None, position_sigma=0.0):
    rays = scene.rays if rays is None else rays
    return observe(
        PosedRays(rays, scene.keyframes, scene.cameras, scene.keyframes.map_T_camera, rays.sigma, position_sigma)
    )[0]


THREE = np.array([[0.3, 0.2, 0.4], [-0.4, 0.3, 0.3], [0.1, -0.5, 0.5]])


@pytest.mark.parametrize("backend", ["numpy", "cpu"])
def test_supports_and_their_sums_over_frames_by_the_plain_formula(backend):
    obs = observed(watch(THREE, circle(40), pixel_sigma=3.0), position_sigma=0.01)
    rng = np.random.default_rng(0)
    points = np.concatenate([THREE, rng.uniform(-1, 1, (20, 3))])
    scorer = _Scorer(obs, SEARCH, backend)
    support = scorer.supports(scorer.load(points))
    to = points[:, None] - obs.origin
    depth = np.einsum("hrj,rj->hr", to, obs.direction)
    offset2 = (to**2).sum(axis=2) - depth**2
    plain = np.clip(1 - offset2 / (SEARCH.gate * ((obs.sigma * depth) ** 2 + obs.position_sigma**2)), 0, 1) * (depth > 0)
    best = np.zeros((len(points), 40))
    np.maximum.at(best, (slice(None), obs.frame), plain)
    np.testing.assert_allclose(as_numpy(scorer.per_frame(support)), best.sum(axis=1), rtol=1e-3, atol=1e-3)
    np.testing.assert_allclose(as_numpy(support.sum(axis=1)), plain.sum(axis=1), rtol=1e-3, atol=1e-3)


def test_points_are_found_among_three_times_as_many_strays():
    scene = watch(THREE, circle(60), pixel_sigma=2.0)
    rng = np.random.default_rng(1)
    frame = np.sort(rng.integers(0, 60, 540))
    centre = rng.uniform([20, 20], [620, 460], (540, 2))
    box = np.column_stack([centre - 10, centre + 10])
    strays = rays_of_boxes(frame, box, np.zeros(540, dtype=np.int64), scene.cameras[0], ("cup",), 2.0)
    both = {
        k: np.concatenate([v, vars(strays)[k]]) for k, v in vars(scene.rays).items() if k != "label_names" and v is not None
    }
    rays = type(strays)(**both, label_names=("cup",))
    found = discover(observed(scene, rays), SEARCH, np.random.default_rng(0))
    gaps = np.linalg.norm(found[:3, None] - THREE, axis=2)
    assert sorted(gaps.argmin(axis=1)) == [0, 1, 2]
    assert gaps.min(axis=1).max() < 0.02


@pytest.mark.parametrize(("count", "most"), [(1, 0), (3, 3), (12, 66), (400, 8 * SEARCH.hypotheses)])
def test_a_search_among_few_rays_tries_each_pair_once(count, most, monkeypatch):
    """The cost of a label with few boxes is that of its pairs, however many hypotheses the settings allow."""
    obs = observed(watch(THREE, circle(200), pixel_sigma=1.0)).take(np.arange(count))
    tried = []

    def counting(obs, first, second):
        tried.append(np.column_stack([first, second]))
        return closest_approach(obs, first, second)

    monkeypatch.setattr("objslam.association.hypothesis_search.closest_approach", counting)
    discover(obs, SEARCH, np.random.default_rng(0))
    (pairs,) = tried
    assert len(pairs) <= most
    if count <= 12:
        assert sorted(map(tuple, pairs.tolist())) == [(i, j) for i in range(count) for j in range(i + 1, count)]


@pytest.mark.parametrize("device", ["cpu", "cuda"])
def test_torch_finds_the_same_points_and_gives_its_threads_back(monkeypatch, device):
    if device == "cuda" and not torch.cuda.is_available():
        pytest.skip("torch sees no CUDA device")
    obs = observed(watch(THREE, circle(20), pixel_sigma=1.0))
    small = discover(obs, SEARCH, np.random.default_rng(0))
    monkeypatch.setattr("objslam.core.array_module.chosen_backend", lambda *_: device)
    before = torch.get_num_threads()
    large = discover(obs, SEARCH, np.random.default_rng(0))
    assert torch.get_num_threads() == before
    np.testing.assert_allclose(large, small, rtol=0, atol=1e-3)  # single precision


def test_refinement_is_the_least_of_the_robust_angles():
    scene = watch(THREE, circle(50), pixel_sigma=3.0)
    obs = observed(scene)
    index = np.argmin([np.linalg.norm(np.cross(p - obs.origin, obs.direction), axis=1) for p in THREE], axis=0)
    fitted = refine(obs, np.arange(len(obs)), index, THREE + 0.05, np.ones(3))
    for j, point in enumerate(fitted):
        mine = index == j

        def residuals(p, mine=mine):
            to = p - obs.origin[mine]
            depth = np.einsum("rj,rj->r", to, obs.direction[mine])
            offset = to - depth[:, None] * obs.direction[mine]
            size = np.linalg.norm(offset, axis=1) / (obs.sigma[mine] * np.linalg.norm(to, axis=1))
            return np.sqrt(6 * np.log1p(size**2 / 6))  # Cauchy's loss of the whole deviation, not of each axis

        best = least_squares(residuals, THREE[j], xtol=1e-14, ftol=1e-14)
        assert np.linalg.norm(point - best.x) < 2e-3
        assert np.linalg.norm(point - THREE[j]) < 0.01


def test_a_point_stays_along_a_direction_that_its_rays_do_not_fix():
    scene = watch(np.array([[2.0, 0.1, 0.4]]), np.broadcast_to(np.eye(4), (30, 4, 4)).copy())
    obs = observed(scene)
    start = np.array([[3.0, 0.2, 0.5]])
    fitted = refine(obs, np.arange(len(obs)), np.zeros(len(obs), dtype=np.int64), start, np.ones(1))
    eye = obs.origin[0]
    assert abs(np.linalg.norm(fitted[0] - eye) - np.linalg.norm(start[0] - eye)) < 0.05
    mean = obs.direction.mean(axis=0)
    assert np.degrees(np.arccos((fitted[0] - eye) @ mean / np.linalg.norm(fitted[0] - eye) / np.linalg.norm(mean))) < 0.05


def test_sizes_show_ranges_where_rays_to_several_things_meet_far_away():
    scene, away = passed_row(pixel_sigma=1.0)
    obs = observed(scene)
    every = np.ones(len(obs), dtype=bool)
    ranged = ranged_by_size(obs, every, SEARCH.gate, SEARCH.parallax, 0)
    np.testing.assert_allclose(ranged.range, away, rtol=0.25)
    assert (ranged.range_sigma > 0.1 * away).all()  # Sizes show ranges less exactly than they seem to.
    some = np.arange(len(obs)) % 2 == 0
    np.testing.assert_array_equal(np.isfinite(ranged_by_size(obs, some, SEARCH.gate, SEARCH.parallax, 0).range), some)


def test_sizes_show_ranges_along_a_street_of_many_equal_things():
    """The more things there are, the fewer pairs of rays are to one of them: 17 %. All rays also meet down the street."""
    rng = np.random.default_rng(0)
    posts = np.array([[5.0 * i, side, 0.5] for i in range(40) for side in (-3.0, 3.0)])
    posts[:, :2] += rng.uniform(-1.0, 1.0, (80, 2))
    poses = lift_se2(np.column_stack([np.linspace(-6.0, 200.0, 400), np.zeros((400, 2))]))
    scene = watch(posts, poses, pixel_sigma=1.0)
    to = posts[scene.whose] - scene.keyframes.map_T_camera[scene.rays.keyframe, :3, 3]
    away = np.linalg.norm(to, axis=1)
    seen = np.flatnonzero((away < 25.0) & (abs(np.degrees(np.arctan2(to[:, 1], to[:, 0]))) < 30.0))
    obs = observed(replace(scene, rays=scene.rays.take(seen), whose=scene.whose[seen]))
    ranged = ranged_by_size(obs, np.ones(len(obs), dtype=bool), SEARCH.gate, SEARCH.parallax, 0)
    to = posts - obs.origin[:, None]
    ahead = np.einsum("rpi,ri->rp", to, obs.direction) / np.linalg.norm(to, axis=2)
    true = np.linalg.norm(to, axis=2)[np.arange(len(obs)), ahead.argmax(axis=1)]
    assert (np.abs(ranged.range / true - 1) < 0.25).mean() > 0.97  # Some posts are just behind others.


def test_sizes_show_no_ranges_where_rays_meet_only_at_the_things():
    obs = observed(watch(THREE, circle(60), pixel_sigma=2.0))
    every = np.ones(len(obs), dtype=bool)
    assert not np.isfinite(ranged_by_size(obs, every, SEARCH.gate, SEARCH.parallax, 0).range).any()


def test_a_known_range_stays_where_sizes_show_others():
    scene, away = passed_row(pixel_sigma=1.0)
    obs = observed(scene)
    known = np.arange(len(obs)) % 3 == 0
    partly = replace(obs, range=np.where(known, 1.1 * away, np.nan), range_sigma=np.where(known, 0.1, np.nan))
    ranged = ranged_by_size(partly, np.ones(len(obs), dtype=bool), SEARCH.gate, SEARCH.parallax, 0)
    assert np.isfinite(ranged.range).all()
    np.testing.assert_array_equal(ranged.range[known], partly.range[known])
    np.testing.assert_array_equal(ranged.range_sigma[known], partly.range_sigma[known])
