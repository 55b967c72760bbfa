"""What the picture and the viewer share."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from synthetic_result import clusters, synthetic_result

from objslam.core.bodies.body import Body, Shape
from objslam.core.object_map import MapObject, ObjectMap
from objslam.output.plot import style
from objslam.output.plot.style import (
    DrawnShape,
    body_outline,
    captions,
    colours_of,
    drawn_shape,
    ellipsoid,
    frame_objects,
    label_colours,
    ray_ends,
    ray_kinds,
    sample,
)

ROOM = np.random.default_rng(0).uniform([0, 0], [10, 15], size=(500, 2))


def test_a_far_object_does_not_squeeze_the_map() -> None:
    objects = np.array([[1.0, 1.0], [9.0, 14.0], [12.0, 5.0], [500.0, -900.0], [np.nan, 0.0]])
    inside, low, high = frame_objects(objects, ROOM)
    assert inside.tolist() == [True, True, True, False, False]
    assert (low >= -1).all()
    assert (high <= 16).all()
    assert high[0] >= 12


def test_objects_round_a_robot_that_stands_are_all_framed() -> None:
    angle = np.linspace(0, 6, 12)
    objects = np.column_stack([3 * np.cos(angle), 3 * np.sin(angle)])
    inside, low, high = frame_objects(objects, np.zeros((50, 2)))
    assert inside.all()
    assert (low <= objects.min(axis=0)).all()
    assert (high >= objects.max(axis=0)).all()


def test_a_far_object_is_out_even_of_two_and_a_lone_one_in() -> None:
    assert frame_objects(np.array([[2.0, 0.0], [300.0, 0.0]]), np.zeros((5, 2)))[0].tolist() == [True, False]
    assert frame_objects(np.array([[300.0, 0.0]]), ROOM)[0].tolist() == [True]


def test_a_pose_that_flew_off_does_not_squeeze_the_map() -> None:
    path = ROOM.copy()
    path[100] = [1e5, 1e5]
    _, _, high = frame_objects(np.array([[5.0, 5.0]]), path)
    assert (high < 30).all()


@pytest.mark.parametrize("dimensions", [2, 3])
def test_nothing_at_all_can_be_framed(dimensions: int) -> None:
    none = np.zeros((0, dimensions))
    inside, low, high = frame_objects(none, none)
    assert inside.shape == (0,)
    assert np.isfinite([low, high]).all()
    _, low, high = frame_objects(np.ones((1, dimensions)), none)
    np.testing.assert_array_equal(low, high)


@given(st.integers(0, 2**32 - 1))
def test_the_ellipsoid_is_where_the_mahalanobis_distance_is_two(seed: int) -> None:
    rng = np.random.default_rng(seed)
    factor = rng.normal(size=(3, 3))
    covariance = factor @ factor.T + 0.01 * np.eye(3)
    o = dataclasses.replace(_object(), covariance=covariance)
    shape = ellipsoid(o)
    assert shape is not None
    half, axes = shape
    assert np.linalg.det(axes) == pytest.approx(1.0)
    on_unit_sphere = rng.normal(size=(20, 3))
    on_unit_sphere /= np.linalg.norm(on_unit_sphere, axis=1, keepdims=True)
    surface = (on_unit_sphere * half) @ axes.T
    distance = np.sqrt(np.einsum("ni,ij,nj->n", surface, np.linalg.inv(covariance), surface))
    np.testing.assert_allclose(distance, 2.0, rtol=1e-6)


def test_no_covariance_no_ellipsoid() -> None:
    assert ellipsoid(_object()) is None
    assert ellipsoid(dataclasses.replace(_object(), covariance=np.full((3, 3), np.nan))) is None
    flat = ellipsoid(dataclasses.replace(_object(), covariance=np.diag([1.0, -1e-20, 0.0])))
    assert flat is not None
    np.testing.assert_allclose(np.sort(flat[0]), [0, 0, 2])


def test_the_id_stands_only_where_a_label_is_shared() -> None:
    objects = ObjectMap(tuple(_object(i, label) for i, label in enumerate(["cup", "book", "cup"])))
    assert captions(objects) == ["cup #0", "book", "cup #2"]


@given(st.integers(1, 60))
def test_colours_differ_and_can_be_read_on_white(count: int) -> None:
    colours = label_colours(ObjectMap(tuple(_object(i, f"label {i}") for i in range(count))))
    assert len(set(colours.values())) == count
    for rgb in colours.values():
        # relative luminance and contrast after WCAG 2.1
        linear = [c / 12.92 if c <= 0.04045 else ((c + 0.055) / 1.055) ** 2.4 for c in rgb]
        luminance = float(np.dot(linear, [0.2126, 0.7152, 0.0722]))
        assert 1.05 / (luminance + 0.05) >= 4.4


def test_one_object_beside_the_path_adds_at_most_a_fifth_to_the_area() -> None:
    square = np.random.default_rng(1).uniform(0, 10, size=(2000, 2))
    areas = []
    for away in np.arange(0.0, 12.0, 0.25):
        inside, low, high = frame_objects(np.array([[5.0, 5.0], [4.0, 6.0], [10.0 + away, 5.0]]), square)
        areas.append(float(np.prod(high - low)))
    assert not inside[2]
    assert max(areas) <= 1.22 * areas[0]


def test_a_label_has_one_colour_in_all_maps() -> None:
    few, many = (colours_of(labels) for labels in (["cup", "plant"], ["book", "chair", "cup", "plant", "tv"]))
    assert few == {name: many[name] for name in few}


@pytest.mark.parametrize(
    ("shape", "length", "sigma", "drawn"),
    [
        ("cuboid", 0.6, 5, "cuboid"),
        ("cuboid", 0.6, 30, "cylinder"),
        ("cuboid", 0.35, 5, "cylinder"),
        ("cylinder", 0.6, 5, "cylinder"),
        ("ellipsoid", 0.6, 5, "ellipsoid"),
        ("sphere", 0.3, 5, "ellipsoid"),
    ],
)
def test_a_body_has_corners_if_its_heading_is_known(shape: Shape, length: float, sigma: float, drawn: DrawnShape) -> None:
    body = Body(shape, np.array([length, 0.3, 1.0]), 0.4, np.array([0.05, 0.02, 0.1]), np.radians(sigma))
    thing = dataclasses.replace(_object(0, "post"), body=body)
    outline, wider = body_outline(thing), body_outline(thing, 2.0)
    assert outline is not None
    assert wider is not None
    axes = np.array([[np.cos(0.4), -np.sin(0.4)], [np.sin(0.4), np.cos(0.4)]])  # along its length, and across
    seen, seen_wider = ((rim - thing.position[:2]) @ axes for rim in (outline, wider))
    np.testing.assert_allclose(np.abs(seen).max(axis=0), [length / 2, 0.15], rtol=1e-3)
    np.testing.assert_allclose(np.abs(seen_wider).max(axis=0), [length / 2 + 0.05, 0.17], rtol=1e-3)
    assert (np.linalg.norm(seen, axis=1).max() > np.hypot(length / 2, 0.15) - 1e-6) == (drawn == "cuboid")
    assert drawn_shape(body) == drawn
    assert body_outline(thing, -13.0) is None  # nothing is left of its length


def test_rays_end_as_far_out_as_their_object() -> None:
    result, _ = synthetic_result(*clusters(), keyframes=20)
    ends, kinds = ray_ends(result), ray_kinds(result)
    assert sum(mask.sum() for mask in kinds.values()) == len(result.rays)
    positions = np.stack([o.position for o in result.map.objects])
    held = result.association.object >= 0
    assert (held == ~kinds["unexplained"]).all()
    target = positions[result.association.object[held]]
    distance = np.linalg.norm(target - result.origins[held], axis=1)
    # an isosceles triangle: its base over the angle off the ray
    np.testing.assert_allclose(
        np.linalg.norm(ends[held] - target, axis=1), 2 * distance * np.sin(result.residual[held] / 2), atol=1e-9
    )
    np.testing.assert_allclose(np.cross(ends - result.origins, result.directions), 0, atol=1e-9)
    assert (result.weight[kinds["rejected"]] < 0.5).all()
    assert (result.weight[kinds["used"]] >= 0.5).all()


def test_rays_without_any_object_still_have_a_length() -> None:
    result, _ = synthetic_result(np.zeros((0, 3)), [], keyframes=5)
    np.testing.assert_allclose(np.linalg.norm(ray_ends(result) - result.origins, axis=1), 2.0)


@given(st.integers(0, 300), st.integers(0, 100), st.integers(0, 9))
def test_a_sample_is_drawn_from_the_mask(size: int, count: int, seed: int) -> None:
    mask = np.random.default_rng(seed).random(size) < 0.5
    chosen = sample(mask, count)
    assert len(chosen) == min(count, int(mask.sum()))
    assert mask[chosen].all()
    assert (np.diff(chosen) > 0).all()


def _object(number: int = 0, label: str = "cup") -> MapObject:
    return MapObject(number, label, np.zeros(3), None, "ok", 3, 3, 10.0, 0.1, 0.0, 1.0)


def test_a_label_that_names_a_colour_has_it():
    labels = ["blue_cone", "Red buoy", "red-cone", "green_buoy", "yellow cone", "person", "tired dog", "bluebell"]
    found = colours_of(labels)
    assert np.argmax([found[name] for name in ("Red buoy", "green_buoy", "blue_cone")], axis=1).tolist() == [0, 1, 2]
    assert np.argmax(found["red-cone"]) == 0  # The nearest free hue is pink.
    r, g, b = found["yellow cone"]
    assert r == pytest.approx(g, abs=0.02)
    assert b < r / 2
    assert len({tuple(np.round(colour, 3)) for colour in found.values()}) == len(labels)
    assert style._named_hue("tired dog") is style._named_hue("bluebell") is None
    for count in (20, 40):  # Names of one colour, more than there are hues.
        many = colours_of([f"red {i}" for i in range(count)])
        assert len(set(many.values())) == count
