"""What map.png and the viewer show alike: colours, labels, where rays end, and how much of the map to frame."""

from __future__ import annotations

import colorsys
from collections import Counter
from typing import Literal

import numpy as np

from objslam.core.arrays import Bools, Floats, Ints
from objslam.core.object_map import MapObject, ObjectMap
from objslam.core.result import RunResult

RayKind = Literal["used", "rejected", "unexplained"]
"""Whether a ray counts for its object, is rejected as an outlier of it, or belongs to no object."""

REJECTED_BELOW = 0.5  # A ray of a lower robust weight, in [0, 1], counts as rejected.
_USUAL_REACH = 2.0  # The length, m, at which rays are drawn where no ray has an object.
_SATURATION = 0.85  # The saturation, in [0, 1], of the colours of labels.
_LUMINANCES = (0.09, 0.17)
"""Relative luminances, in [0, 1], that neighbouring hues take in turn, so that many colours stay apart. Both give text on
white a contrast of 4.5 and more (WCAG 2.1)."""
_FENCE = (3.0, 0.5, 1.0)
"""An object is framed within the largest of three distances from the path: this many times the usual one, this share of the
path's diagonal, and this many m. Larger values frame more far objects and make everything else smaller."""


def is_date(stamp: float) -> bool:
    """Whether a stamp, s, is a date in Unix time: it is past the first three years, which no other clock counts to."""
    return stamp > 1e8


def ray_kinds(result: RunResult) -> dict[RayKind, Bools]:
    """Which rays (R,) hold an object, are rejected as its outliers, or are explained by no object."""
    explained = result.association.object >= 0
    used = explained & (result.weight >= REJECTED_BELOW)
    return {"used": used, "rejected": explained & ~used, "unexplained": ~explained}


def ray_ends(result: RunResult) -> Floats:
    """Where each ray ends (R, 3): as far out as its object; a ray without one ends as far out as rays usually do."""
    index = result.association.object
    reach = np.full(len(index), np.nan)
    held = index >= 0
    if held.any():
        positions = np.stack([o.position for o in result.map.objects])
        reach[held] = np.linalg.norm(positions[index[held]] - result.origins[held], axis=1)
    usual = float(np.nanmedian(reach)) if np.isfinite(reach).any() else _USUAL_REACH
    return result.origins + np.where(np.isfinite(reach), reach, usual)[:, None] * result.directions


def captions(objects: ObjectMap) -> list[str]:
    """What to write at each object: its label, with #id where several objects share it."""
    shared = Counter(o.label for o in objects.objects)
    return [o.label if shared[o.label] == 1 else f"{o.label} #{o.id}" for o in objects.objects]


def label_colours(objects: ObjectMap) -> dict[str, tuple[float, float, float]]:
    """A colour (r, g, b in [0, 1]) for each label, all dark enough for text on white (contrast 4.5 and more)."""
    names = sorted({o.label for o in objects.objects})
    return {name: _colour(i / len(names), i) for i, name in enumerate(names)}


def object_colours(objects: ObjectMap) -> list[tuple[float, float, float]]:
    """A colour for each object: the first of a label has the label's, the others lie on the way to the next label's."""
    names = sorted({o.label for o in objects.objects})
    shared, met = Counter(o.label for o in objects.objects), Counter[str]()
    colours = []
    for o in objects.objects:
        i, k = names.index(o.label), met[o.label]
        met[o.label] += 1
        colours.append(_colour((i + 0.8 * k / shared[o.label]) / len(names), i + k))
    return colours


def _colour(hue: float, number: int) -> tuple[float, float, float]:
    linear = np.array(colorsys.hsv_to_rgb(hue, _SATURATION, 1.0)) ** 2.2
    linear *= _LUMINANCES[number % 2] / float(linear @ [0.2126, 0.7152, 0.0722])  # the eye's weights of red, green, blue
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
    """At most `count` of the indices that a mask (N,) selects, in order.

    They are drawn at random, because every n-th ray may belong to the same object.
    """
    index = np.flatnonzero(mask)
    if len(index) <= count:
        return index
    return np.sort(np.random.default_rng(0).choice(index, count, replace=False))


def evenly(count: int, most: int) -> Ints:
    """At most `most` of the indices 0 to count - 1, evenly spaced, the first and the last among them."""
    return np.linspace(0, count - 1, min(count, most)).round().astype(np.int64)


def frame_objects(objects: Floats, path: Floats) -> tuple[Bools, Floats, Floats]:
    """Which objects (N, D) to frame together with the path (K, D), and the corners (D,), (D,) of what to show.

    One object far away must not squeeze the map. The path's box is trimmed by 1 % on each side, half of the objects stand
    within the usual distance of it, and an object is framed within `_FENCE`.
    """
    if len(path):
        low, high = np.quantile(path, 0.01, axis=0), np.quantile(path, 0.99, axis=0)
    else:
        low = high = np.median(objects, axis=0) if len(objects) else np.zeros(path.shape[1])
    diagonal = float(np.linalg.norm(high - low))
    off = np.linalg.norm(np.maximum(np.maximum(low - objects, objects - high), 0.0), axis=1)
    usual = float(np.sort(off)[(len(off) - 1) // 2]) if len(off) else 0.0
    fence = max(_FENCE[0] * usual, _FENCE[1] * diagonal, _FENCE[2])
    inside = np.isfinite(off) & (off <= fence)
    near = path[((path >= low - fence) & (path <= high + fence)).all(axis=1)]
    shown = np.concatenate([near, objects[inside], np.stack([low, high])])
    return inside, shown.min(axis=0), shown.max(axis=0)
