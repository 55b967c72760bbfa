"""A furnished room for rendered drives: walls, tables, shelves and cabinets, with things standing on them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from objslam.core.arrays import Floats, Ints
from objslam.core.geometry import lift_se2
from objslam.errors import ConfigError
from objslam.simulation.shapes import Material, Part, Pattern, ball, box, make_object, paint, torus, turned

CEILING = 2.6
"""m."""
SLOT = 0.34
"""m of a top's width that each thing on it has for itself."""


@dataclass(frozen=True)
class Lamp:
    """A point light: position (3,) m and the light it gives, linear colour (3,), at 1 m."""

    position: Floats
    power: Floats


@dataclass(frozen=True)
class Room:
    """What is rendered: parts; owner (P,), the object a part belongs to, -1 for the rest; objects' labels and middles.

    middle: (N, 3) m in map, the middle of each object's bounding box. lamps and the ambient light (3,), linear.
    """

    parts: tuple[Part, ...]
    owner: Ints
    labels: tuple[str, ...]
    middle: Floats
    lamps: tuple[Lamp, ...]
    ambient: Floats


def furnish_room(size: tuple[float, float], labels: Sequence[str], rng: np.random.Generator) -> Room:
    """A room of a size along x and y (m), the middle of its floor at the origin, with objects of the given labels.

    Furniture stands along the walls and reaches at most 0.6 m into the room; each object stands on a piece of it, next to
    other things. ConfigError where the furniture has no place for all the objects.
    """
    parts = [*_shell(size, rng)]
    spots = []
    for wall in range(4):
        pieces, tops = _wall_row(size, wall, rng)
        parts += pieces
        spots += tops
    if len(spots) < len(labels):
        raise ConfigError(f"the furniture has {len(spots)} places, not the {len(labels)} needed", hint="a larger room")
    order = rng.permutation(len(spots))
    owner = [-1] * len(parts)
    middles = []
    for number, label in enumerate(labels):
        standing = [part.moved(spots[order[number]] @ _spin(rng)) for part in make_object(label, rng)]
        points = np.concatenate([part.vertices for part in standing])
        middles.append((points.min(axis=0) + points.max(axis=0)) / 2)
        parts += standing
        owner += [number] * len(standing)
    for spot in order[len(labels) :]:
        if rng.random() < 0.75:
            thing = [part.moved(spots[spot] @ _spin(rng)) for part in _distractor(rng)]
            parts += thing
            owner += [-1] * len(thing)
    lamps, ambient = _light(size, rng)
    return Room(tuple(parts), np.array(owner), tuple(labels), np.array(middles).reshape(-1, 3), lamps, ambient)


def any_material(rng: np.random.Generator, scale: tuple[float, float] = (0.01, 0.08)) -> Material:
    """A material of any colour and pattern."""
    patterns: tuple[Pattern, ...] = ("plain", "noise", "stripes", "checks")
    pattern = patterns[rng.choice(4, p=[0.4, 0.3, 0.2, 0.1])]
    first = paint(rng, rng.random(), rng.random() ** 1.5, rng.uniform(0.05, 0.95))
    second = first * rng.uniform(0.4, 0.9) if rng.random() < 0.7 else paint(rng, rng.random(), rng.random(), rng.random())
    return Material(first, second, pattern, float(rng.uniform(*scale)), float(rng.uniform(0.0, 0.35)))


def _spin(rng: np.random.Generator) -> Floats:
    return lift_se2(np.array([0.0, 0.0, rng.uniform(0.0, 2 * np.pi)]))


def _light(size: tuple[float, float], rng: np.random.Generator) -> tuple[tuple[Lamp, ...], Floats]:
    warmth = rng.uniform(-0.15, 0.15)
    tint = np.array([1 + warmth, 1.0, 1 - warmth])
    count = int(rng.integers(1, 3))
    lamps = []
    for _ in range(count):
        place = np.array([*(rng.uniform(-0.35, 0.35, 2) * np.array(size)), CEILING - 0.15])
        lamps.append(Lamp(place, rng.uniform(1.8, 3.2) / count * tint))
    return tuple(lamps), rng.uniform(0.25, 0.5) * (tint + 1) / 2


def _wood(rng: np.random.Generator) -> Material:
    colour = paint(rng, rng.uniform(0.04, 0.11), rng.uniform(0.2, 0.6), rng.uniform(0.25, 0.8))
    return Material(colour, colour * rng.uniform(0.6, 0.9), "stripes", float(rng.uniform(0.015, 0.05)), 0.1)


def _flat(rng: np.random.Generator) -> Material:
    colour = paint(rng, rng.random(), rng.uniform(0.0, 0.3), rng.uniform(0.4, 0.95))
    return Material(colour, colour * rng.uniform(0.85, 1.0), "noise", 0.05, 0.0)


def _shell(size: tuple[float, float], rng: np.random.Generator) -> list[Part]:
    x, y = size
    walls = _flat(rng)
    floor = (_wood(rng), any_material(rng, (0.1, 0.4)), _flat(rng))[rng.integers(3)]
    parts = [
        box((x + 0.2, y + 0.2, 0.1), (0, 0, -0.05), floor),
        box((x + 0.2, y + 0.2, 0.1), (0, 0, CEILING + 0.05), Material(np.full(3, 0.85), np.full(3, 0.8), "noise", 0.1, 0.0)),
        box((x, 0.1, CEILING), (0, -y / 2 - 0.05, CEILING / 2), walls),
        box((x, 0.1, CEILING), (0, y / 2 + 0.05, CEILING / 2), walls),
        box((0.1, y, CEILING), (-x / 2 - 0.05, 0, CEILING / 2), walls if rng.random() < 0.6 else _flat(rng)),
        box((0.1, y, CEILING), (x / 2 + 0.05, 0, CEILING / 2), walls),
    ]
    corners = [(sx * (x / 2 - 0.3), sy * (y / 2 - 0.3)) for sx in (-1, 1) for sy in (-1, 1)]
    for cx, cy in corners:
        if rng.random() < 0.6:
            bottom, height = rng.uniform(0.1, 0.22), rng.uniform(0.3, 1.6)
            bin_or_lamp = turned([(bottom, 0.0), (bottom * rng.uniform(0.4, 1.1), height)], any_material(rng))
            parts.append(bin_or_lamp.moved(lift_se2(np.array([cx, cy, 0.0]))))
    return parts


def _wall_row(size: tuple[float, float], wall: int, rng: np.random.Generator) -> tuple[list[Part], list[Floats]]:
    """The furniture along one wall, and poses (4, 4) of the places on its tops."""
    along, across = (size[0], size[1]) if wall % 2 == 0 else (size[1], size[0])
    # the row is laid out along x with the wall at y = 0 and the room below it, then turned to its wall
    to_wall = lift_se2(np.array([0.0, 0.0, wall * np.pi / 2])) @ lift_se2(np.array([0.0, across / 2, 0.0]))
    parts: list[Part] = []
    spots: list[Floats] = []
    end = along / 2 - 0.65
    at = -end + rng.uniform(0.0, 0.25)
    while at + 0.45 <= end:
        width = float(min(rng.uniform(0.45, 1.4), end - at))
        depth, height = float(rng.uniform(0.36, 0.58)), float(rng.uniform(0.35, 0.75))
        middle = at + width / 2
        style = rng.integers(3)
        piece = (_table, _shelf, _cabinet)[style](width, depth, height, rng)
        pose = to_wall @ lift_se2(np.array([middle, -depth / 2 - 0.02, 0.0]))
        parts += [part.moved(pose) for part in piece]
        columns = max(int(width / SLOT), 1)
        for column in range(columns):
            offset = (column + 0.5) / columns * width - width / 2 + rng.uniform(-0.02, 0.02)
            spot = pose @ lift_se2(np.array([offset, rng.uniform(-1, 1) * max(depth / 2 - 0.15, 0.0), 0.0]))
            spot[2, 3] = height
            spots.append(spot)
        at += width + float(rng.uniform(0.05, 0.5))
    for _ in range(int(rng.integers(1, 4))):
        picture = (rng.uniform(0.2, 0.9), 0.02, rng.uniform(0.2, 0.8))
        place = (rng.uniform(-1, 1) * (along / 2 - 0.6), -0.01, rng.uniform(1.3, 1.9))
        parts.append(box(picture, place, any_material(rng, (0.03, 0.3))).moved(to_wall))
    return parts, spots


def _table(width: float, depth: float, height: float, rng: np.random.Generator) -> list[Part]:
    top, legs = (_wood(rng) if rng.random() < 0.6 else any_material(rng)), any_material(rng)
    feet = [(sx * (width / 2 - 0.04), sy * (depth / 2 - 0.04)) for sx in (-1, 1) for sy in (-1, 1)]
    parts = [box((width, depth, 0.03), (0, 0, height - 0.015), top)]
    return parts + [box((0.04, 0.04, height - 0.03), (x, y, (height - 0.03) / 2), legs) for x, y in feet]


def _shelf(width: float, depth: float, height: float, rng: np.random.Generator) -> list[Part]:
    wood = _wood(rng) if rng.random() < 0.6 else _flat(rng)
    boards = [box((width, depth, 0.025), (0, 0, z), wood) for z in (0.05, height / 2, height - 0.0125)]
    sides = [box((0.025, depth, height), (sx * (width / 2 - 0.0125), 0, height / 2), wood) for sx in (-1, 1)]
    books = []
    at = -width / 2 + 0.04
    while at < width / 2 - 0.1:
        thick, tall = rng.uniform(0.02, 0.06), min(rng.uniform(0.1, 0.25), height / 2 - 0.08)
        books.append(box((thick, 0.15, tall), (at + thick / 2, -0.03, 0.0625 + tall / 2), any_material(rng)))
        at += thick + rng.choice([0.002, 0.1], p=[0.8, 0.2])
    return boards + sides + books


def _cabinet(width: float, depth: float, height: float, rng: np.random.Generator) -> list[Part]:
    case = any_material(rng, (0.02, 0.1)) if rng.random() < 0.5 else _wood(rng)
    knob = any_material(rng)
    parts = [box((width, depth, height), (0, 0, height / 2), case)]
    for x in (-width / 4, width / 4):
        parts.append(box((0.02, 0.03, 0.12), (x, -depth / 2 - 0.015, height * 0.65), knob))
    return parts


def _distractor(rng: np.random.Generator) -> list[Part]:
    """Something that is none of the seven: boxes, tins, bottles, balls, cones, rings and posts of other forms."""
    first, second = any_material(rng), any_material(rng)
    r, h = float(rng.uniform(0.03, 0.08)), float(rng.uniform(0.06, 0.28))
    w, d = rng.uniform(0.06, 0.22, 2)
    kinds = (
        lambda: [box((w, d, h), (0, 0, h / 2), first)],
        lambda: [box((w, d, 0.04), (0, 0, 0.02), first), box((w * 0.8, d * 0.9, 0.03), (0, 0, 0.055), second)],
        lambda: [turned([(r, 0.0), (r * rng.uniform(0.8, 1.2), h)], first)],
        lambda: [turned([(r, 0.0), (r, h * 0.6), (r * 0.35, h * 0.8), (r * 0.35, h)], first)],
        lambda: [turned([(r * 0.6, 0.0), (r * 1.3, h * 0.4)], first)],
        lambda: [ball(r, r, first)],
        lambda: [turned([(r, 0.0), (0.005, h)], first)],
        lambda: [box((0.02, d, h), (0, 0, h / 2), first), box((w, d, 0.02), (0, 0, 0.01), first)],
        lambda: [turned([(r, 0.0), (r, 0.02), (0.01, 0.03), (0.01, h)], first), box((w, 0.01, 0.1), (0, 0, h), second)],
        lambda: [torus(r, r * 0.5, r * 0.5, first), turned([(r * 0.5, 0.0), (r * 0.5, h * 0.5)], second)],
    )
    return kinds[rng.integers(len(kinds))]()
