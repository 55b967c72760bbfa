"""Appearance vectors in association: the ratio against closed forms, and what it changes and does not change."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from association_scenes import Scene, drive
from scipy.stats import norm

from objslam.association.appearance.cosine_ratio import MOST_RATIO, CosineRatio, Density, Pairs
from objslam.association.appearance.evidence import Looks, learn_ratio
from objslam.association.correlative_alignment import align
from objslam.core.appearance.features import FeatureTable, unit_vectors
from objslam.core.arrays import Floats, Ints
from objslam.core.types import Association, Rays
from objslam.mapping.joint.merge_and_split import merge_unseen_together
from objslam.simulation import AppearanceNoise, DriveSettings

ONE = np.zeros(1, dtype=np.int64)


def density(mean: float, between: float, within: float) -> Density:
    return Density(np.array([mean]), np.array([between]), np.array([within]))


def labels(values: Floats | Ints) -> Ints:
    return np.zeros(len(values), dtype=np.int64)


def test_the_ratio_is_that_of_two_gaussians() -> None:
    ratio = CosineRatio(density(0.6, 0.01, 0.04), density(0.4, 0.01, 0.03))
    x, n = np.linspace(0.3, 0.7, 9), np.arange(1, 10)
    expected = norm.logpdf(x, 0.6, np.sqrt(0.01 + 0.04 * (1 + 1 / n))) - norm.logpdf(
        x, 0.4, np.sqrt(0.01 + 0.03 * (1 + 1 / n))
    )
    np.testing.assert_allclose(ratio.log_ratio(x, labels(x), 1, n), expected, atol=1e-12)


@pytest.mark.parametrize(("own", "their"), [(0.001, 0.05), (0.05, 0.001), (0.01, 0.01)])
def test_the_ratio_never_falls_with_the_cosine_and_is_bounded(own: float, their: float) -> None:
    ratio = CosineRatio(density(0.8, own, own), density(0.3, their, their))
    x = np.linspace(-1, 1, 401)
    found = ratio.log_ratio(x, labels(x), 1, 4)
    assert (np.diff(found) >= -1e-12).all()
    assert found.min() >= -MOST_RATIO
    assert found.max() <= MOST_RATIO
    assert found[0] < 0 < found[-1]


def random_pairs(rng: np.random.Generator, mean: float, groups: int, each: int, between: float, within: float) -> Pairs:
    """Cosines between two single boxes, so that their variance is between + 2 within."""
    group = np.repeat(np.arange(groups), each)
    x = mean + np.sqrt(between) * rng.normal(size=groups)[group] + np.sqrt(2 * within) * rng.normal(size=len(group))
    return Pairs(x, labels(group), group)


def test_both_parts_of_the_variance_are_found() -> None:
    rng = np.random.default_rng(0)
    ratio = CosineRatio.learn(random_pairs(rng, 0.7, 800, 12, 0.01, 0.005), random_pairs(rng, 0.2, 800, 12, 0.003, 0.02), 1)
    for found, mean, between, within in ((ratio.same, 0.7, 0.01, 0.005), (ratio.different, 0.2, 0.003, 0.02)):
        np.testing.assert_allclose(found.mean, mean, atol=0.01)
        np.testing.assert_allclose(found.between, between, rtol=0.2)
        np.testing.assert_allclose(found.within, within, rtol=0.1)
    assert ratio.informative


def test_a_short_log_teaches_little() -> None:
    rng = np.random.default_rng(0)
    strength = []
    for number in (2, 20, 200):
        pairs = (random_pairs(rng, mean, number, 1, 0.004, 0.003) for mean in (0.5, 0.3))
        ratio = CosineRatio.learn(*pairs, 1)
        strength.append(float(ratio.log_ratio(np.array([0.5]), ONE, 1, 1)[0]))
    assert strength[0] < 0.5
    assert strength[0] < strength[1] < strength[2]


def test_a_label_has_its_own_means() -> None:
    rng = np.random.default_rng(0)
    same = [random_pairs(rng, mean, 300, 1, 0.001, 0.001) for mean in (0.95, 0.6)]
    different = [random_pairs(rng, mean, 300, 1, 0.001, 0.001) for mean in (0.8, 0.2)]
    label, group = np.repeat([0, 1], 300), np.arange(600)
    both = [Pairs(np.concatenate([p.cosine for p in pairs]), label, group) for pairs in (same, different)]
    ratio = CosineRatio.learn(*both, 2)
    odds = ratio.log_ratio(np.array([0.8, 0.6]), np.array([0, 1]), 1, 1)
    assert odds[0] < 0 < odds[1]  # 0.8 are two objects of the one label, 0.6 one object of the other.


def with_vectors(rays: Rays, vectors: Floats) -> Rays:
    units, good = unit_vectors(vectors)
    row = np.where(good, np.cumsum(good) - 1, -1)
    return replace(rays, feature=row, feature_table=FeatureTable(units[good]))


@pytest.fixture(scope="module")
def clusters() -> Scene:
    """Two clusters of three cups, 0.35 m apart, seen with an error of 3 degrees."""
    turn = 2 * np.pi / 3 * np.arange(3)
    places = [
        ("cup", (x + 0.2 * np.cos(a), y + 0.2 * np.sin(a), 0.4)) for x, y in ((0.0, 2.4), (3.3, 0.0)) for a in turn.tolist()
    ]
    noise = {"pixel_sigma": 20.0, "missed": 0.2, "false": 0.2, "appearance": AppearanceNoise()}
    return drive(DriveSettings.model_validate({"objects": 0, "placed": tuple(places), **noise}), 1, 20.0)


def purity(scene: Scene, association: Association) -> float:
    """The share of the boxes of true objects that are with the most frequent object of their landmark."""
    right = 0
    for j in range(association.count):
        mine = scene.whose[association.object == j]
        right += np.bincount(mine[mine >= 0]).max(initial=0)
    return right / int((scene.whose >= 0).sum())


def test_vectors_tell_close_objects_apart(clusters: Scene) -> None:
    bare = clusters.associate(rays=replace(clusters.rays, feature=None, feature_table=None))
    found = clusters.associate()
    missing, left = (1 - purity(clusters, one) for one in (bare, found))
    assert missing > 0.2
    assert left < missing / 2


def test_vectors_that_say_nothing_change_nothing(clusters: Scene) -> None:
    rays = clusters.rays
    bare = clusters.associate(rays=replace(rays, feature=None, feature_table=None))
    rng = np.random.default_rng(0)
    for vectors in (np.ones((len(rays), 3)), rng.normal(size=(len(rays), 64)), np.full((len(rays), 3), np.nan)):
        found = clusters.associate(rays=with_vectors(rays, vectors))
        for name in ("object", "label", "existence", "refuted"):
            np.testing.assert_array_equal(getattr(found, name), getattr(bare, name))


def test_a_wrong_ratio_does_not_divide_an_object_seen_from_two_sides(clusters: Scene) -> None:
    """The back of a thing looks as different as another thing. Its rays still meet in one point."""
    rng = np.random.default_rng(0)
    keyframe = clusters.rays.keyframe
    side = (keyframe > np.median(keyframe)).astype(np.int64)
    look = rng.normal(size=(2, clusters.whose.max() + 2, 32))[side, clusters.whose]
    found = clusters.associate(rays=with_vectors(clusters.rays, look + 0.2 * rng.normal(size=look.shape)))
    assert found.count == len(clusters.points)


def test_a_ray_is_compared_with_the_other_rays_of_a_landmark(clusters: Scene) -> None:
    rays, owner = clusters.rays, clusters.whose
    assert rays.feature is not None
    assert rays.feature_table is not None
    ratio = learn_ratio(rays, rays.keyframe, rays.track_id, owner, 1)
    assert ratio is not None
    looks, vectors = Looks.of(rays, owner, 6, ratio), rays.feature_table.vectors.astype(np.float64)[rays.feature]
    ray = np.flatnonzero(owner >= 0)[:40]
    for landmark in range(3):
        own = owner[ray] == landmark
        found = looks.ray_odds(rays, ray, np.full(len(ray), landmark), own)
        for i, r in enumerate(ray.tolist()):
            others = np.flatnonzero((owner == landmark) & (np.arange(len(rays)) != r))
            expected = ratio.log_ratio(np.array([(vectors[others] @ vectors[r]).mean()]), ONE, 1, len(others))
            np.testing.assert_allclose(found[i], expected[0], atol=1e-3)
    a, b = np.array([0, 0]), np.array([1, 2])
    for found_one, i, j in zip(looks.landmark_odds(a, b, labels(a)), a, b, strict=True):
        one, two = vectors[owner == i], vectors[owner == j]
        expected = ratio.log_ratio(np.array([(one @ two.T).mean()]), ONE, len(one), len(two))
        np.testing.assert_allclose(found_one, expected[0], atol=1e-3)


def test_the_ratio_is_learnt_from_tracks_before_there_are_landmarks(clusters: Scene) -> None:
    rays = clusters.rays
    nobody = np.full(len(rays), -1)
    assert learn_ratio(rays, rays.keyframe, nobody, nobody, 1) is None
    assert learn_ratio(rays, rays.keyframe, clusters.whose, nobody, 1) is not None


def test_short_vectors_have_nearly_the_cosines_of_long_ones() -> None:
    rng = np.random.default_rng(0)
    vectors, _ = unit_vectors(rng.normal(size=(500, 40)) @ rng.normal(size=(40, 300)) + 0.1 * rng.normal(size=(500, 300)))
    table = FeatureTable(vectors)
    assert table.compact.shape == (500, 64)
    np.testing.assert_allclose(table.compact @ table.compact.T, vectors @ vectors.T, atol=0.01)
    assert FeatureTable(vectors[:, :64]).compact.shape == (500, 64)


@pytest.mark.parametrize(("alike", "count"), [(True, 1), (False, 2)])
def test_two_copies_merge_only_if_they_look_alike(clusters: Scene, alike: bool, count: int) -> None:
    """Two copies of one object, never seen together. Their positions agree as one pair in fifty would."""

    class Solved:
        positions = np.array([[1.0, 0.0, 0.4], [1.0, 0.0, 0.4 + np.sqrt(2 * 9.8) * 0.1], *np.eye(3)[[0, 1, 2, 0]] * 50.0])
        covariance = np.tile(0.01 * np.eye(3), (6, 1, 1))

    rays = clusters.rays.take(np.flatnonzero(clusters.whose >= 0))
    owner = clusters.whose[clusters.whose >= 0]
    late = rays.keyframe > np.median(rays.keyframe)
    mine = np.isin(owner, [0, 1])
    kept = ~mine | (late == (owner == 1))
    rays, owner = rays.take(kept), owner[kept]
    thing = np.where((owner == 1) & alike, 0, owner)
    rng = np.random.default_rng(0)
    rays = with_vectors(rays, rng.normal(size=(6, 32))[thing] + 0.3 * rng.normal(size=(len(rays), 32)))
    found = merge_unseen_together(rays, Association(owner, np.zeros(6, dtype=np.int64)), Solved(), 2.0)  # type: ignore[arg-type]
    assert found.count == 4 + count


def test_an_alignment_prefers_the_landmark_that_looks_alike(clusters: Scene) -> None:
    """Two landmarks side by side, and one ray between them."""
    ray, origin = clusters.rays.take(np.array([0])), np.eye(4)[None]
    ray = replace(ray, keyframe=np.array([0]), direction=np.array([[1.0, 0.0, 0.0]]), sigma=np.array([0.01]))
    places, where = np.array([[2.0, 0.2, 0.0], [2.0, -0.2, 0.0]]), np.zeros(3)
    for best in (0, 1):
        alike = np.where(np.arange(2) == best, 3.0, -3.0)[None]
        spread, share = np.array([0.01, 0.01, 0.1]), np.ones(1)
        correction = align(ray, places, np.zeros(2, dtype=np.int64), origin, where, spread, share, alike)
        assert np.sign(correction[0, 1, 0]) == (1 if best == 0 else -1)
