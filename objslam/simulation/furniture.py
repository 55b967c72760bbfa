"""Make random furnished rooms for rendered drives: walls, tables, shelves and cabinets, with objects on them."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from objslam.core.arrays import Floats, Ints
from objslam.core.geometry import lift_se2
from objslam.errors import ConfigError
from objslam.simulation.shapes import Material, Part, Pattern, ball, box, make_object, paint, torus, turned

CEILING = 2.6  # The height of the ceiling, m.
SLOT = 0.34  # The width that each object gets on a piece of furniture, m. With a larger value, fewer objects fit.


@dataclass(frozen=True)
class Lamp:
    """A point light. position: (3,) in map, m. power: (3,) the linear RGB colour of its light."""

    position: Floats
    power: Floats


@dataclass(frozen=True)
class Room:
    """The content of a rendered room.

    parts: the P meshes. owner: (P,) the id of the object to which each part belongs, -1 for furniture and other things.
    labels: the labels of the N objects. middle: (N, 3) the centre of each object's bounding box in map, m. ambient: (3,) the
    linear RGB colour of ambient light.
    """

    parts: tuple[Part, ...]
    owner: Ints
    labels: tuple[str, ...]
    middle: Floats
    lamps: tuple[Lamp, ...]
    ambient: Floats


def object_sizes(room: Room) -> tuple[Floats, Floats]:
    """Return the sizes (N, 3), m, and the yaws (N,), rad, of the smallest upright boxes around the objects. A size is
    length, width and height. The yaw is the direction of the length in map."""
    yaws = np.radians(np.arange(180))
    turns = np.stack([np.stack([np.cos(yaws), np.sin(yaws)]), np.stack([-np.sin(yaws), np.cos(yaws)])])  # (side, axis, yaw)
    sizes, best = np.zeros((len(room.labels), 3)), np.zeros(len(room.labels))
    for number in range(len(room.labels)):
        points = np.concatenate([part.vertices for part, of in zip(room.parts, room.owner, strict=True) if of == number])
        sides = np.ptp(np.einsum("va,say->vsy", points[:, :2], turns), axis=0)  # (side, yaw)
        sides[:, sides[0] < sides[1]] = np.inf  # The length is the longer side.
        at = int(sides.prod(axis=0).argmin())
        sizes[number], best[number] = [*sides[:, at], np.ptp(points[:, 2])], yaws[at]
    return sizes, best


def furnish_room(size: tuple[float, float], labels: Sequence[str], rng: np.random.Generator) -> Room:
    """Make a furnished room with one object for each label. size: the size of the room along x and y, m.

    The origin is the centre of the floor. Furniture along the walls reaches at most 0.6 m into the room. The objects stand
    on the furniture, and other things stand between them. Raises ConfigError if the furniture has no place for all objects.
    """
    parts = _shell(size, rng)
    spots = []
    for wall in range(4):
        pieces, tops = _wall_row(size, wall, rng)
        parts += pieces
        spots += tops
    if len(spots) < len(labels):
        raise ConfigError(f"the furniture has {len(spots)} places, not the {len(labels)} needed", hint="set a larger room")
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
            parts += [part.moved(spots[spot] @ _spin(rng)) for part in _distractor(rng)]
    owner += [-1] * (len(parts) - len(owner))
    middle = np.array(middles).reshape(-1, 3)
    return Room(tuple(parts), np.array(owner), tuple(labels), middle, *_light(size, rng))


def any_material(rng: np.random.Generator, scale: tuple[float, float] = (0.01, 0.08)) -> Material:
    """Draw a material of any colour and pattern. scale: the range of the pattern's scale, m."""
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
    lamps = tuple(
        Lamp(np.append(rng.uniform(-0.35, 0.35, 2) * size, CEILING - 0.15), rng.uniform(1.8, 3.2) / count * tint)
        for _ in range(count)
    )
    return lamps, rng.uniform(0.25, 0.5) * (tint + 1) / 2


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
    for cx, cy in [(sx * (x / 2 - 0.3), sy * (y / 2 - 0.3)) for sx in (-1, 1) for sy in (-1, 1)]:
        if rng.random() < 0.6:
            bottom, height = rng.uniform(0.1, 0.22), rng.uniform(0.3, 1.6)
            bin_or_lamp = turned([(bottom, 0.0), (bottom * rng.uniform(0.4, 1.1), height)], any_material(rng))
            parts.append(bin_or_lamp.moved(lift_se2(np.array([cx, cy, 0.0]))))
    return parts


def _wall_row(size: tuple[float, float], wall: int, rng: np.random.Generator) -> tuple[list[Part], list[Floats]]:
    along, across = size if wall % 2 == 0 else size[::-1]
    # In the coordinate frame of the row, the wall is at y = 0 and the room is at negative y.
    to_wall = lift_se2(np.array([0.0, 0.0, wall * np.pi / 2])) @ lift_se2(np.array([0.0, across / 2, 0.0]))
    parts: list[Part] = []
    spots: list[Floats] = []
    end = along / 2 - 0.65
    at = -end + rng.uniform(0.0, 0.25)
    while at + 0.45 <= end:
        width = float(min(rng.uniform(0.45, 1.4), end - at))
        depth, height = float(rng.uniform(0.36, 0.58)), float(rng.uniform(0.35, 0.75))
        piece = (_table, _shelf, _cabinet)[rng.integers(3)](width, depth, height, rng)
        pose = to_wall @ lift_se2(np.array([at + width / 2, -depth / 2 - 0.02, 0.0]))
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
    posts = [box((0.04, 0.04, height - 0.03), (x, y, (height - 0.03) / 2), legs) for x, y in feet]
    return [box((width, depth, 0.03), (0, 0, height - 0.015), top), *posts]


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
    knobs = [box((0.02, 0.03, 0.12), (x, -depth / 2 - 0.015, height * 0.65), knob) for x in (-width / 4, width / 4)]
    return [box((width, depth, height), (0, 0, height / 2), case), *knobs]


def _distractor(rng: np.random.Generator) -> list[Part]:
    """Make a random thing that is not one of the paper's seven objects: a box, tin, bottle, ball, cone, ring or post."""
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
