"""Make the triangle meshes of rendered rooms: primitives, materials, and the paper's seven objects."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from objslam.core.arrays import Floats, Ints

LABELS = ("ring", "sponge", "dispenser_button", "probe", "button", "stand_a", "stand_b")
"""The labels of the paper's seven objects."""
Pattern = Literal["plain", "noise", "stripes", "checks"]


@dataclass(frozen=True)
class Material:
    """The look of a surface: a 3D pattern of two linear RGB colours (3,). scale: the size of the pattern, m. gloss: the
    strength of the reflections of lamps, 0 for a dull surface."""

    colour: Floats
    second: Floats
    pattern: Pattern = "plain"
    scale: float = 0.02
    gloss: float = 0.1


@dataclass(frozen=True)
class Part:
    """A mesh of one material: vertices (V, 3), m, and triangles (T, 3), counter-clockwise seen from outside."""

    vertices: Floats
    triangles: Ints
    material: Material

    def moved(self, pose: Floats) -> Part:
        """Return the part with its vertices transformed by a pose (4, 4)."""
        return replace(self, vertices=self.vertices @ pose[:3, :3].T + pose[:3, 3])


def box(size: tuple[float, float, float], middle: tuple[float, float, float], material: Material) -> Part:
    """Make a box from its size along x, y, z and its centre, m."""
    corners = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)])
    quads = ((0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3))
    return Part(corners * np.array(size) + np.array(middle), _split(np.array(quads)), material)


def turned(profile: list[tuple[float, float]], material: Material, segments: int = 28) -> Part:
    """Make a closed body of revolution around z from a profile of (radius, height), m, from the bottom up."""
    rings = np.array([(0.0, profile[0][1]), *profile, (0.0, profile[-1][1])])
    return _swept(rings, False, material, segments)


def torus(radius: float, thickness: float, height: float, material: Material, segments: int = 36) -> Part:
    """Make a horizontal ring. radius: the radius of the centre line, m. thickness: the radius of the tube, m. height: the
    height of the ring's centre, m."""
    angle = np.linspace(0.0, 2 * np.pi, 14, endpoint=False)
    rings = np.column_stack([radius + thickness * np.cos(angle), height + thickness * np.sin(angle)])
    return _swept(rings, True, material, segments)


def ball(radius: float, height: float, material: Material) -> Part:
    """Make a sphere with its centre on the z axis at a height, m."""
    angle = np.linspace(-np.pi / 2, np.pi / 2, 15)[1:-1]
    return turned([(radius * np.cos(a), height + radius * np.sin(a)) for a in angle], material)


def _split(quads: Ints) -> Ints:
    return np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])


def _swept(rings: Floats, closed: bool, material: Material, segments: int) -> Part:
    turn = np.linspace(0.0, 2 * np.pi, segments, endpoint=False)
    radius = rings[:, :1]
    vertices = np.stack([radius * np.cos(turn), radius * np.sin(turn), np.tile(rings[:, 1:], (1, segments))], axis=-1)
    count = len(rings)
    ring = np.arange(count if closed else count - 1)[:, None]
    column = np.arange(segments)[None]
    after, beside = (ring + 1) % count, (column + 1) % segments
    corners = (ring * segments + column, ring * segments + beside, after * segments + beside, after * segments + column)
    quads = np.stack([np.broadcast_to(c, (len(ring), segments)) for c in corners], axis=-1).reshape(-1, 4)
    return Part(vertices.reshape(-1, 3), _split(quads), material)


def paint(rng: np.random.Generator, hue: float, saturation: float, value: float) -> Floats:
    """Draw a random linear RGB colour (3,) near a hue, a saturation and a value (each 0 to 1)."""
    hue += rng.normal(0.0, 0.012)
    saturation = float(np.clip(saturation + rng.normal(0.0, 0.05), 0.0, 1.0))
    value = float(np.clip(value + rng.normal(0.0, 0.05), 0.02, 1.0))
    wheel = np.abs((hue + np.array([1.0, 2 / 3, 1 / 3])) % 1.0 * 6.0 - 3.0) - 1.0
    return np.asarray(value * (1 - saturation + saturation * np.clip(wheel, 0.0, 1.0)))


def _plastic(rng: np.random.Generator, hue: float, saturation: float, value: float) -> Material:
    colour = paint(rng, hue, saturation, value)
    return Material(colour, colour, gloss=float(rng.uniform(0.1, 0.4)))


def make_object(label: str, rng: np.random.Generator) -> list[Part]:
    """Make one of the seven objects on z = 0 around the z axis, with a random size factor of 0.92 to 1.08."""
    scale = float(rng.uniform(0.92, 1.08))
    return [replace(part, vertices=part.vertices * scale) for part in _parts(label, rng)]


def _parts(label: str, rng: np.random.Generator) -> list[Part]:
    if label == "ring":
        first, _ = _plastic(rng, 0.09, 0.9, 0.9), _plastic(rng, 0.0, 0.0, 0.9)  # The unused draw keeps later draws the same.
        return [torus(0.095, 0.026, 0.026, Material(first.colour, first.colour * 0.75, "noise", 0.03, 0.3))]
    if label == "sponge":
        foam, pad = paint(rng, 0.155, 0.75, 0.9), paint(rng, 0.36, 0.75, 0.3)
        return [
            box((0.17, 0.11, 0.055), (0, 0, 0.0275), Material(foam, foam * 0.55, "noise", 0.006, 0.0)),
            box((0.17, 0.11, 0.022), (0, 0, 0.066), Material(pad, pad * 0.6, "noise", 0.004, 0.0)),
        ]
    if label == "dispenser_button":
        body, key, dark = _plastic(rng, 0.58, 0.05, 0.85), _plastic(rng, 0.6, 0.85, 0.7), _plastic(rng, 0.0, 0.0, 0.08)
        return [
            turned([(0.06, 0.0), (0.062, 0.15), (0.045, 0.17)], body),
            turned([(0.063, 0.05), (0.063, 0.085)], dark),
            turned([(0.04, 0.17), (0.042, 0.2), (0.03, 0.215)], key),
        ]
    if label == "probe":
        steel, tip = _plastic(rng, 0.6, 0.05, 0.5), _plastic(rng, 0.985, 0.9, 0.65)
        return [turned([(0.055, 0.0), (0.05, 0.02), (0.014, 0.03), (0.014, 0.19)], steel), ball(0.036, 0.22, tip)]
    if label == "button":
        case, head = _plastic(rng, 0.15, 0.9, 0.85), _plastic(rng, 0.99, 0.9, 0.7)
        return [
            box((0.15, 0.15, 0.07), (0, 0, 0.035), case),
            turned([(0.03, 0.07), (0.03, 0.09), (0.058, 0.095), (0.055, 0.12), (0.03, 0.13)], head),
        ]
    if label == "stand_a":
        blue, white = _plastic(rng, 0.62, 0.85, 0.55), _plastic(rng, 0.0, 0.0, 0.9)
        return [
            turned([(0.1, 0.0), (0.1, 0.015), (0.07, 0.02), (0.05, 0.105)], blue),
            turned([(0.05, 0.105), (0.04, 0.15)], white),
            turned([(0.04, 0.15), (0.025, 0.21)], blue),
        ]
    if label == "stand_b":
        green = _plastic(rng, 0.4, 0.8, 0.5)
        plates = [box((0.02, 0.14, 0.15), (x, 0, 0.095), green) for x in (-0.08, 0.0, 0.08)]
        return [box((0.2, 0.14, 0.02), (0, 0, 0.01), green), *plates]
    raise ValueError(f"no object is called {label!r}")
