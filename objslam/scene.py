"""What the picture and the viewer show alike: colours, labels, where rays end, and how much of the map to frame."""

from __future__ import annotations

import colorsys
from collections import Counter
from typing import TYPE_CHECKING, Literal

import numpy as np

from objslam.types import Bools, Floats, Ints, MapObject, ObjectMap

if TYPE_CHECKING:
    from objslam.results import RunResult

RayKind = Literal["used", "rejected", "unexplained"]
REJECTED_BELOW = 0.5
"""A ray with a lower robust weight counts as rejected."""


def ray_kinds(result: RunResult) -> dict[RayKind, Bools]:
    """Which rays (R,) hold an object, are rejected as its outliers, or are explained by no object."""
    explained = result.association.object >= 0
    used = explained & (result.weight >= REJECTED_BELOW)
    return {"used": used, "rejected": explained & ~used, "unexplained": ~explained}


def ray_ends(result: RunResult) -> Floats:
    """Where each ray ends (R, 3): on the ray, as far out as its object; as far as rays usually reach where it has none."""
    index = result.association.object
    reach = np.full(len(index), np.nan)
    held = index >= 0
    if held.any():
        positions = np.stack([o.position for o in result.map.objects])
        reach[held] = np.linalg.norm(positions[index[held]] - result.origins[held], axis=1)
    usual = float(np.nanmedian(reach)) if np.isfinite(reach).any() else 2.0
    return result.origins + np.where(np.isfinite(reach), reach, usual)[:, None] * result.directions


def captions(objects: ObjectMap) -> list[str]:
    """What to write at each object: its label, with #id where several share it."""
    shared = Counter(o.label for o in objects.objects)
    return [o.label if shared[o.label] == 1 else f"{o.label} #{o.id}" for o in objects.objects]


def label_colours(objects: ObjectMap) -> dict[str, tuple[float, float, float]]:
    """A colour (r, g, b in [0, 1]) for each label, all dark enough for text on white (contrast 4.5 and more)."""
    names = sorted({o.label for o in objects.objects})
    return {name: _colour(i / len(names), i) for i, name in enumerate(names)}


def object_colours(objects: ObjectMap) -> list[tuple[float, float, float]]:
    """A colour for each object: that of its label for the first of them, the others from there towards the next label's."""
    names = sorted({o.label for o in objects.objects})
    shared, met = Counter(o.label for o in objects.objects), Counter[str]()
    colours = []
    for o in objects.objects:
        i, k = names.index(o.label), met[o.label]
        met[o.label] += 1
        colours.append(_colour((i + 0.8 * k / shared[o.label]) / len(names), i + k))
    return colours


def _colour(hue: float, number: int) -> tuple[float, float, float]:
    linear = np.array(colorsys.hsv_to_rgb(hue, 0.85, 1.0)) ** 2.2
    # neighbours on the wheel alternate in luminance, so that many colours stay apart
    linear *= (0.09, 0.17)[number % 2] / float(linear @ [0.2126, 0.7152, 0.0722])
    r, g, b = np.clip(linear, 0.0, 1.0) ** (1 / 2.2)
    return float(r), float(g), float(b)


def ellipsoid(o: MapObject, sigmas: float = 2.0) -> tuple[Floats, Floats] | None:
    """Half axes (3,), m, of an object's covariance and their directions (3, 3) in columns, right-handed; None without."""
    if o.covariance is None or not np.isfinite(o.covariance).all():
        return None
    values, axes = np.linalg.eigh(o.covariance)
    axes[:, 0] *= np.sign(np.linalg.det(axes))
    return sigmas * np.sqrt(np.maximum(values, 0.0)), axes


def sample(mask: Bools, count: int) -> Ints:
    """At most `count` of the indices that a mask (N,) selects, in order, drawn at random: every n-th may be one object's."""
    index = np.flatnonzero(mask)
    if len(index) <= count:
        return index
    return np.sort(np.random.default_rng(0).choice(index, count, replace=False))


def frame_objects(objects: Floats, path: Floats) -> tuple[Bools, Floats, Floats]:
    """Which objects (N, D) to frame together with the path (K, D), and the corners (D,), (D,) of what to show.

    One object far away must not squeeze the map: an object is framed when it stands no farther from the (trimmed) box of
    the path than three times what half of the objects do, or half that box's diagonal.
    """
    if len(path):
        low, high = np.quantile(path, 0.01, axis=0), np.quantile(path, 0.99, axis=0)
    else:
        low = high = np.median(objects, axis=0) if len(objects) else np.zeros(path.shape[1])
    diagonal = float(np.linalg.norm(high - low))
    off = np.linalg.norm(np.maximum(np.maximum(low - objects, objects - high), 0.0), axis=1)
    usual = float(np.sort(off)[(len(off) - 1) // 2]) if len(off) else 0.0
    fence = max(3.0 * usual, 0.5 * diagonal, 1.0)
    inside = np.isfinite(off) & (off <= fence)
    near = path[((path >= low - fence) & (path <= high + fence)).all(axis=1)]
    shown = np.concatenate([near, objects[inside], np.stack([low, high])])
    return inside, shown.min(axis=0), shown.max(axis=0)
