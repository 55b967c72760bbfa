"""The map as an object: queries against brute force, fusion against the information form, files to the last bit."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import chi2, multivariate_normal

from objslam import ObjectMap
from objslam.core.arrays import Floats
from objslam.core.object_map import MapObject
from objslam.errors import OutputError
from objslam.io.objects_json import dump_objects

_SEEDS = st.integers(0, 2**32 - 1)


def thing(number: int, label: str, position: Floats | list[float], sigma: float | Floats = 0.1, **more: object) -> MapObject:
    covariance = sigma if isinstance(sigma, np.ndarray) else np.eye(3) * sigma**2
    o = MapObject(number, label, np.array(position, dtype=float), covariance, "ok", 10, 9, 30.0, 0.5, 1.0, 2.0)
    return replace(o, **more)  # type: ignore[arg-type]


def random_map(seed: int, count: int = 30) -> ObjectMap:
    rng = np.random.default_rng(seed)
    objects = [thing(i, rng.choice(["cup", "chair"]), rng.uniform(-5, 5, 3)) for i in range(count)]
    lost = replace(thing(count, "cup", [0, 0, 0]), status="unresolved", covariance=None)
    return ObjectMap((*objects, lost))


@settings(max_examples=30)
@given(_SEEDS, st.sampled_from([2, 3]), st.sampled_from([None, "cup", "table"]))
def test_queries_find_what_a_loop_finds(seed: int, dimensions: int, label: str | None) -> None:
    objects, rng = random_map(seed), np.random.default_rng(seed + 1)
    point, radius = rng.uniform(-5, 5, dimensions), rng.uniform(0, 6)
    low, high = np.sort(rng.uniform(-5, 5, (2, dimensions)), axis=0)
    near, boxed = [], []
    for o in objects.objects:
        if o.status == "ok" and (label is None or o.label == label):
            distance = float(np.sqrt(sum((o.position[i] - point[i]) ** 2 for i in range(dimensions))))
            near.append((distance, o.id))
            if all(low[i] <= o.position[i] <= high[i] for i in range(dimensions)):
                boxed.append(o.id)
    near.sort()
    nearest = objects.nearest(point, label)
    assert (nearest.id if nearest else None) == (near[0][1] if near else None)
    assert [o.id for o in objects.in_radius(point, radius, label)] == [i for distance, i in near if distance <= radius]
    assert [o.id for o in objects.in_box(low, high, label)] == boxed


def test_queries_at_equal_distances_and_open_boxes() -> None:
    """The first of several nearest objects counts, and a corner of a box may be at infinity."""
    objects = ObjectMap(
        tuple(thing(i, "cup", [x, y, i]) for i, (x, y) in enumerate([(1, 0), (0, 1), (-1, 0), (0, -1), (3, 3)]))
    )
    nearest = objects.nearest([0, 0])
    assert nearest is not None
    assert nearest.id == 0
    assert [o.id for o in objects.in_radius([0, 0], 1)] == [0, 1, 2, 3]
    assert [o.id for o in objects.in_radius([0, 0], np.inf)] == [0, 1, 2, 3, 4]
    assert [o.id for o in objects.in_box([-np.inf, 0, -np.inf], [np.inf, np.inf, 3])] == [0, 1, 2]
    assert [o.id for o in objects.in_box([0, 1], [0, 1])] == [1]
    assert replace(objects, objects=objects.objects[4:]).nearest([0, 0]) == objects[4]  # A new map has an index of its own.
    with pytest.raises(ValueError, match="finite"):
        objects.nearest([np.inf, 0])
    for radius in (-1.0, np.nan):
        with pytest.raises(ValueError, match="0 m or more"):
            objects.in_radius([0, 0], radius)
    with pytest.raises(ValueError, match="must not lie above"):
        objects.in_box([1, 1], [0, 0])


@pytest.mark.parametrize("point", [[1.0], [1, 2, 3, 4], [np.nan, 0], "door"])
def test_points_that_are_none(point: object) -> None:
    with pytest.raises(ValueError):
        random_map(0).nearest(point)  # type: ignore[arg-type]
    with pytest.raises(ValueError):
        random_map(0).in_box([0, 0], point)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="both corners"):
        random_map(0).in_box([0, 0], [1, 1, 1])


def test_an_empty_map_has_nothing() -> None:
    empty = ObjectMap(())
    assert empty.nearest([0, 0]) is None
    assert empty.in_radius([0, 0], 9) == empty.in_box([0, 0], [1, 1]) == ()
    assert empty.merge(empty) == empty


def test_saved_and_loaded_it_is_the_same(tmp_path: Path) -> None:
    objects = random_map(5)
    objects.save(tmp_path / "objects.json")
    for path in (tmp_path, tmp_path / "objects.json", str(tmp_path)):
        back = ObjectMap.load(path)
        assert dump_objects(back) == dump_objects(objects)
        for a, b in zip(objects.objects, back.objects, strict=True):
            np.testing.assert_array_equal(a.position, b.position)
    assert [file.name for file in tmp_path.iterdir()] == ["objects.json"]
    with pytest.raises(OutputError, match="no such result folder"):
        ObjectMap.load(tmp_path / "nowhere")
    with pytest.raises(OutputError):
        objects.save(tmp_path / "nowhere" / "objects.json")


def spd(rng: np.random.Generator) -> Floats:
    root = rng.normal(scale=0.1, size=(3, 3))
    return root @ root.T + 1e-4 * np.eye(3)


@settings(max_examples=30)
@given(_SEEDS)
def test_two_measurements_are_fused_by_their_information(seed: int) -> None:
    rng = np.random.default_rng(seed)
    a, b = spd(rng), spd(rng)
    place = rng.uniform(-5, 5, 3)
    one = ObjectMap((thing(4, "cup", place, a),))
    other = ObjectMap((thing(0, "cup", place + 0.5 * np.linalg.cholesky(a + b)[:, 0], b),))
    (fused,) = one.merge(other).objects
    information = np.linalg.inv(a) + np.linalg.inv(b)
    np.testing.assert_allclose(fused.covariance, np.linalg.inv(information), rtol=1e-4, atol=1e-9)
    weighted = np.linalg.inv(a) @ one.objects[0].position + np.linalg.inv(b) @ other.objects[0].position
    np.testing.assert_allclose(fused.position, np.linalg.solve(information, weighted), atol=1e-6)
    # the fused density is the product of the two, up to a constant: equal ratios at any two points
    points = fused.position + rng.normal(scale=0.05, size=(4, 3))
    product = sum(multivariate_normal(o.position, o.covariance).logpdf(points) for o in (one.objects[0], other.objects[0]))
    np.testing.assert_allclose(
        np.diff(multivariate_normal(fused.position, fused.covariance).logpdf(points)), np.diff(product), atol=1e-2
    )


def test_what_else_is_known_is_put_together() -> None:
    a = thing(3, "cup", [0, 0, 0], rays=30, rms_deg=1.0, extent=(0.1, 0.2), labels={"cup": 1.0}, existence=0.9)
    b = thing(0, "cup", [0, 0, 0], rays=10, rms_deg=3.0, extent=(0.3, 0.2), labels={"cup": 0.6, "bowl": 0.4}, existence=0.7)
    b = replace(b, first_seen=0.5, last_seen=9.0, parallax_deg=80.0)
    (o,) = ObjectMap((a,)).merge(ObjectMap((b,))).objects
    assert (o.id, o.label, o.rays, o.frames, o.first_seen, o.last_seen) == (3, "cup", 40, 18, 0.5, 9.0)
    assert (o.parallax_deg, o.existence) == (80.0, 0.9)
    assert o.rms_deg == pytest.approx(np.sqrt((30 * 1 + 10 * 9) / 40))
    assert o.extent == pytest.approx((0.15, 0.2))
    assert o.labels == pytest.approx({"cup": 0.9, "bowl": 0.1})


def test_the_same_is_what_the_covariances_allow() -> None:
    """1 % of equal objects are told apart, and nothing that is further than the quantile is put together."""
    limit = np.sqrt(chi2(3).ppf(0.99) * 2 * 0.1**2)
    for factor, count in ((0.999, 1), (1.001, 2)):
        a, b = thing(0, "cup", [0, 0, 0]), thing(0, "cup", [0, factor * limit, 0])
        assert len(ObjectMap((a,)).merge(ObjectMap((b,)))) == count
    assert len(ObjectMap((thing(0, "cup", [0, 0, 0]),)).merge(ObjectMap((thing(0, "mug", [0, 0, 0]),)))) == 2


def test_merging_is_one_to_one_with_the_least_sum() -> None:
    """Taken greedily, the nearest pair (b with c) would leave a and d, too far apart, alone."""
    a, b = thing(0, "cup", [0.0, 0, 0]), thing(1, "cup", [0.4, 0, 0])
    c, d = thing(0, "cup", [0.35, 0, 0]), thing(1, "cup", [0.75, 0, 0])
    merged = ObjectMap((a, b)).merge(ObjectMap((c, d))).objects
    assert len(merged) == 2
    np.testing.assert_allclose([o.position[0] for o in merged], [0.175, 0.575], atol=1e-6)


def test_objects_that_only_one_map_has_are_kept_and_numbered_on() -> None:
    ours, theirs = random_map(1), random_map(2)
    merged = ours.merge(theirs)
    assert len({o.id for o in merged.objects}) == len(merged)
    assert [o.id for o in merged.objects[: len(ours)]] == [o.id for o in ours.objects]
    assert sum(o.rays for o in merged.objects) == sum(o.rays for m in (ours, theirs) for o in m.objects)
    # merged with itself every resolved object is found again, twice as sure
    twice = ours.merge(ours)
    assert len(twice.resolved()) == len(ours.resolved())
    for once, o in zip(ours.resolved(), twice.resolved(), strict=True):
        np.testing.assert_allclose(o.position, once.position)
        np.testing.assert_allclose(o.covariance, once.covariance / 2, rtol=1e-4)


def test_frames_must_agree() -> None:
    with pytest.raises(ValueError, match=r"'map' and 'odom'"):
        random_map(0).merge(replace(random_map(0), frame="odom"))


def test_perfectly_known_objects_are_the_same_only_where_they_are() -> None:
    exact = np.zeros((3, 3))
    one = ObjectMap((thing(0, "cup", [1, 2, 3], exact),))
    assert len(one.merge(one)) == 1
    assert len(one.merge(ObjectMap((thing(0, "cup", [1, 2, 3.001], exact),)))) == 2


def test_importing_the_map_is_light() -> None:
    code = "import sys; from objslam import ObjectMap; print(*sys.modules)"
    modules = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.split()
    assert not {"torch", "gtsam", "open3d", "rerun", "onnxruntime", "cv2", "scipy"} & set(modules)


def test_an_object_at_another_position_is_a_replaced_one() -> None:
    one = MapObject(3, "box", np.array([1.0, 2.0, 3.0]), np.eye(3), "ok", 10, 9, 30.0, 0.5, 1.0, 2.0, extent=(0.2, 0.4))
    there = np.array([4.0, 5.0, 6.0])
    assert vars(one.at(there)) == vars(replace(one, position=there))
    assert one.position.tolist() == [1.0, 2.0, 3.0]
