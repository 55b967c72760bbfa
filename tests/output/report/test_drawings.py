"""The drawings of the report against what they stand for: the 3D view's data, sketches, timelines, neighbours."""

from __future__ import annotations

import base64
import re
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from synthetic_result import clusters, synthetic_result

from objslam.core.arrays import Floats
from objslam.core.bodies.body import Body
from objslam.core.object_map import ObjectMap
from objslam.core.types import Truth, Up
from objslam.io.rays_parquet import RaysTable
from objslam.output.report.cards import make_cards
from objslam.output.report.crops import choose_rays, choose_unexplained
from objslam.output.report.scene import scene_data, upright
from objslam.output.report.sketch import sketch
from objslam.output.report.timeline import HEIGHT, WIDTH, timeline
from objslam.output.result_folder import rays_table


def unpack(text: str, columns: int) -> Floats:
    return np.frombuffer(base64.b64decode(text), "<f4").reshape(-1, columns).astype(np.float64)


def a_map(**changes: Any) -> tuple[Any, RaysTable, Truth | None]:
    result, truth = synthetic_result(*clusters(), keyframes=60, **changes)
    return result, rays_table(result), truth


@pytest.mark.parametrize("up", ["z", "-y", "x"])
def test_the_view_has_the_map_and_its_rays_with_z_up(up: Up) -> None:
    result, rays, truth = a_map(unresolved=(4,))
    data = scene_data(result.map, rays, result.path_after, truth, up)
    turn = upright(up)
    assert np.linalg.det(turn) == pytest.approx(1.0)
    assert (turn @ (np.eye(3)["xyz".index(up[-1])] * (-1 if up[0] == "-" else 1))).tolist() == [0, 0, 1]
    for o, drawn in zip(result.map, data["objects"], strict=True):
        assert (drawn["id"], drawn["ok"]) == (o.id, o.status == "ok")
        np.testing.assert_allclose(turn.T @ drawn["at"], o.position, atol=1e-3)
        if o.covariance is not None:
            half = turn.T @ np.array(drawn["axes"]).T
            np.testing.assert_allclose(half @ half.T / 4, o.covariance, atol=1e-3)
    np.testing.assert_allclose(unpack(data["path"], 3)[-1] @ turn, result.path_after.poses[-1, :3, 3], atol=1e-4)
    ends = unpack(data["rays"], 6)
    assert len(ends) == len(data["of"])
    positions = {o.id: o.position for o in result.map}
    for of, begin, end in zip(data["of"], ends[:, :3] @ turn, ends[:, 3:] @ turn, strict=True):
        (row,) = np.flatnonzero((rays.object == of) & (np.abs(rays.origin - begin).max(axis=1) < 1e-4))[:1]
        reach = np.linalg.norm(positions[of] - begin)
        np.testing.assert_allclose(end, begin + reach * rays.direction[row], atol=1e-3)
    used = (rays.object >= 0) & (rays.weight >= 0.5)
    assert data["used"] == used.sum()


@pytest.mark.parametrize("up", ["z", "-y"])
def test_the_view_has_the_bodies_with_their_headings(up: Up) -> None:
    result, rays, truth = a_map()
    body = Body("cuboid", np.array([0.6, 0.4, 0.9]), np.pi / 3, np.full(3, 0.01), 0.1)
    bodies = (
        body,
        replace(body, shape="cylinder"),
        replace(body, yaw_sigma=0.6),  # A cuboid whose corners may be anywhere.
        replace(body, shape="ellipsoid"),
        None,
    )
    many = len(bodies)
    changed = [replace(o, body=one) for o, one in zip(result.map.objects[:many], bodies, strict=True)]
    objects = ObjectMap((*changed, *result.map.objects[many:]))
    drawn = scene_data(objects, rays, result.path_after, truth, up)["objects"][:many]
    assert [one["shape"] for one in drawn] == ["cuboid", "cylinder", "cylinder", "ellipsoid", "point"]
    cuboid, *_, point = drawn
    assert point["body"] == []
    assert all(one["body"] == cuboid["body"] for one in drawn[:-1])
    half = np.array(cuboid["body"]) @ upright(up)  # back to the frame of the map
    np.testing.assert_allclose(half[0], 0.3 * np.array([0.5, np.sqrt(3) / 2, 0.0]), atol=1e-3)
    np.testing.assert_allclose(half[1], 0.2 * np.array([-np.sqrt(3) / 2, 0.5, 0.0]), atol=1e-3)
    np.testing.assert_allclose(half[2], [0, 0, 0.45], atol=1e-3)


def test_a_timeline_stands_where_the_rays_are() -> None:
    stamps = np.concatenate([np.full(4, 10.0), np.full(16, 15.0), [20.0]])
    used = np.array([True] * 4 + [False] * 16 + [True])
    drawn = timeline(stamps, used, 10.0, 20.0)

    def bars(text: str) -> list[tuple[float, ...]]:
        found = re.findall(r"M(\d+) ([\d.]+)v-([\d.]+)h1v([\d.]+)z", text)
        assert "".join(f"M{a} {b}v-{c}h1v{d}z" for a, b, c, d in found) == text
        return [tuple(float(part) for part in bar) for bar in found]

    assert bars(drawn.used) == [(0, HEIGHT, HEIGHT / 2, HEIGHT / 2), (WIDTH - 1, HEIGHT, HEIGHT / 4, HEIGHT / 4)]
    assert bars(drawn.rejected) == [(WIDTH / 2, HEIGHT, HEIGHT, HEIGHT)]


def test_a_sketch_has_its_rays_from_above() -> None:
    origins = np.array([[0.0, 0.0], [4.0, 0.0], [2.0, -1.0]])
    position = np.array([2.0, 2.0])
    directions = position - origins
    directions[2] = [1.0, 0.0]
    used = np.array([True, True, False])
    path = np.array([[0.0, 0.0], [4.0, 0.0]])
    drawn = sketch(origins, directions, used, position, np.diag([0.04, 0.01]), path, np.array([[2.5, 2.0], [90.0, 0.0]]))
    assert drawn is not None
    lines = np.array(re.findall(r"M([-\d.]+) ([-\d.]+)L([-\d.]+) ([-\d.]+)", drawn.used), dtype=float)
    scale = drawn.bar / float(drawn.metres.removesuffix(" m"))
    np.testing.assert_allclose(lines[:, 2:], np.tile(drawn.dot, (2, 1)), atol=0.1)  # both rays meet the object
    back = (lines[:, :2] - drawn.dot) / scale * [1, -1] + position  # SVG has y down
    np.testing.assert_allclose(back, origins[:2], atol=0.02)
    ((a, b, c, d),) = np.array(re.findall(r"M([-\d.]+) ([-\d.]+)L([-\d.]+) ([-\d.]+)", drawn.rejected), dtype=float)
    assert (d, (c - a) / scale) == pytest.approx((b, 3.0), abs=0.02)  # as long as the way to the object
    rim = np.array(re.findall(r"[ML]([-\d.]+) ([-\d.]+)", drawn.ellipse), dtype=float)
    np.testing.assert_allclose(np.ptp(rim, axis=0) / scale, [0.8, 0.4], atol=0.02)
    assert len(drawn.others) == 1
    assert sketch(origins, directions, used, np.full(2, np.nan), None, path, path) is None


def test_a_card_names_the_nearest_of_its_label() -> None:
    result, rays, _ = a_map()
    cards = {card.object.id: card for card in make_cards(result.map, rays, {}, {}, result.map_T_base[:, :3, 3], "z")}
    for o in result.map:
        others = [x for x in result.map if x.label == o.label and x.id != o.id]
        expected = sorted(np.linalg.norm(x.position - o.position) for x in others)[:2]
        assert [n.distance for n in cards[o.id].neighbours] == pytest.approx(expected)
    card = cards[result.map[0].id]
    if card.neighbours:
        other = card.neighbours[0].object
        apart = other.position - card.object.position
        squared = apart @ np.linalg.inv(card.object.covariance + other.covariance) @ apart
        assert card.neighbours[0].sigmas == pytest.approx(np.sqrt(squared))


def test_the_worst_and_the_rejected_have_pictures_too() -> None:
    result, rays, _ = a_map()
    rays = RaysTable(**{**vars(rays), "weight": rays.weight.copy()})
    mine = np.flatnonzero(rays.object == result.map[0].id)
    rays.weight[mine] = np.where(np.arange(len(mine)) % 4 == 3, 0.0, 1.0)
    kinds = choose_rays(rays, mine, 4)
    by_kind = {kind: [ray for ray, of in kinds.items() if of == kind] for kind in ("best", "worst", "rejected")}
    assert [len(found) for found in by_kind.values()] == [4, 2, 2]
    assert (rays.weight[by_kind["rejected"]] == 0).all()
    rest = [ray for ray in mine if ray not in kinds and rays.weight[ray] > 0]
    off = rays.residual / rays.sigma
    assert off[by_kind["worst"]].min() >= off[rest].max()
    assert choose_rays(rays, mine, 0) == {}


def test_boxes_of_no_object_are_shown_by_label() -> None:
    _, rays, _ = a_map()
    rays = RaysTable(**{**vars(rays), "object": np.where(np.arange(len(rays)) % 3 == 0, -1, rays.object)})
    label = str(rays.label[0])
    chosen = choose_unexplained(rays, label, 4)
    assert len(chosen) == 4
    assert all(rays.object[ray] == -1 and rays.label[ray] == label for ray in chosen)
    assert choose_unexplained(rays, "nothing", 4) == choose_unexplained(rays, label, 0) == {}
