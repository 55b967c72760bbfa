"""A body as values of plain types, for files and tables."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from objslam.core.arrays import Floats
from objslam.core.bodies.body import SHAPES, Body
from objslam.core.validity import MAX_POSITION

_SIDES = ("size_l", "size_w", "size_h")
_SIGMAS = tuple(f"{name}_sigma" for name in (*_SIDES, "yaw"))
BODY_COLUMNS = {"shape": "string", **dict.fromkeys((*_SIDES, "yaw", *_SIGMAS), "float64")}
"""The columns of a body in a table of objects, with their types: sizes in m, yaws in rad."""
_TURN = 2 * math.pi  # The largest yaw in a file, rad. A larger bound accepts angles in degrees.


def body_entry(body: Body) -> dict[str, Any]:
    """Return the values of a body for JSON. `body_of_entry` restores them."""
    sides = {"size": body.size.tolist(), "size_sigma": body.size_sigma.tolist()}
    return {"shape": body.shape, **sides, "yaw": float(body.yaw), "yaw_sigma": float(body.yaw_sigma)}


def body_of_entry(entry: Mapping[str, Any]) -> Body | None:
    """Return the body in the JSON entry of an object, None for a point. ValueError if the entry is malformed."""
    shape = next((one for one in SHAPES if one == entry.get("shape", "point")), None)
    if shape is None:
        raise ValueError(f"shape must be one of {', '.join(SHAPES)}, got {str(entry.get('shape'))[:60]!r}")
    if shape == "point":
        return None
    yaw: Any = entry.get("yaw")
    sigma: Any = entry.get("yaw_sigma")
    if not (_finite(yaw) and _finite(sigma) and abs(yaw) <= _TURN and 0 <= sigma <= _TURN):
        raise ValueError("yaw and yaw_sigma must be angles in radians")
    return Body(shape, size_of(entry, "size"), float(yaw), size_of(entry, "size_sigma"), float(sigma))


def size_of(entry: Mapping[str, Any], name: str) -> Floats:
    """Return the length, width and height (3,), m, under `name` in a JSON entry. ValueError if the value is malformed."""
    size: Any = entry.get(name)
    if not isinstance(size, list) or len(size) != 3 or not all(_finite(x) and 0 <= x < MAX_POSITION for x in size):
        raise ValueError(f"{name} must be a length, a width and a height in metres")
    return np.array(size, dtype=np.float64)


def body_row(body: Body | None) -> tuple[str | float | None, ...]:
    """Return the values of a body in a table row."""
    if body is None:
        return ("point", *[None] * 8)
    return (body.shape, *body.size.tolist(), body.yaw, *body.size_sigma.tolist(), body.yaw_sigma)


def _finite(value: Any) -> bool:
    """Return whether a JSON value is a number that a float can hold."""
    good = isinstance(value, int | float) and not isinstance(value, bool)
    return good and -1e300 < value < 1e300
