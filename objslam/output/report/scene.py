"""Make the data of the 3D view on the page, which scene.js draws. The frame of the view has z up."""

import base64
from collections.abc import Sequence
from typing import Any

import numpy as np

from objslam.core.arrays import Floats
from objslam.core.object_map import ObjectMap
from objslam.core.trajectory import Trajectory
from objslam.core.types import Truth, Up
from objslam.frontend.up import from_above, up_vector
from objslam.io.rays_parquet import RaysTable
from objslam.output.plot.figure import Colour
from objslam.output.plot.style import (
    REJECTED_BELOW,
    captions,
    drawn_shape,
    ellipsoid,
    evenly,
    frame_objects,
    label_colours,
    sample,
)

_MAX_USED, _MAX_REJECTED = 1500, 300
"""The largest numbers of used and of rejected rays in the view. More rays make the page larger and the view slower, and hide
objects."""
_MAX_PATH = 1000  # The largest number of poses of a path. More poses make the page larger, without a visible difference.


def upright(up: Up) -> Floats:
    """Return the rotation (3, 3) from the map's frame to the frame of the view, which has z up."""
    return np.stack([*np.eye(3)[from_above(up)], up_vector(up)])


def scene_data(
    objects: ObjectMap,
    rays: RaysTable | None,
    path: Trajectory | None,
    truth: Truth | None,
    up: Up,
    colours: Sequence[Colour] | None = None,
) -> dict[str, Any]:
    """Return the data of the view as JSON values. Positions are in the frame of the view, m.

    The rays, the path and the true path are float32 arrays in base64. A site has neither rays nor a path. The value of
    "axes" is the map's axes in the frame of the view. truth: the ground truth in the frame of the map. up: the axis of the
    map that points up. colours: the colour of each object. The default is the colour of its label.
    """
    turn = upright(up)
    names, of_label = captions(objects), label_colours(objects)
    colours = [of_label[o.label] for o in objects] if colours is None else colours
    shown = [i for i, o in enumerate(objects) if np.isfinite(o.position).all()]
    positions = objects.positions @ turn.T
    way = np.zeros((0, 3)) if path is None else path.poses[:, :3, 3] @ turn.T
    _, low, high = frame_objects(positions, way)
    return {
        "axes": [[name, turn[:, i].round(3).tolist()] for i, name in enumerate("xyz")],
        "low": low.round(3).tolist(),
        "high": high.round(3).tolist(),
        "objects": [
            {
                "id": objects[i].id,
                "name": names[i],
                "colour": hexadecimal(colours[i]),
                "ok": objects[i].status == "ok",
                "at": positions[i].round(3).tolist(),
                "axes": _half_axes(objects, i, turn),
                "body": _body(objects, i, turn),
                "shape": "point" if (body := objects[i].body) is None else drawn_shape(body),
            }
            for i in shown
        ],
        "path": _packed(way[evenly(len(way), _MAX_PATH)]),
        "truth": [] if truth is None else [(turn @ t.position).round(3).tolist() for t in truth.objects],
        "true_path": _packed(_thinned(truth, turn)),
        **({"rays": "", "of": [], "used": 0} if rays is None else _rays(objects, rays, turn)),
    }


def hexadecimal(colour: tuple[float, float, float]) -> str:
    """Return a colour, r, g, b in [0, 1], in the form #rrggbb of CSS."""
    return "#" + "".join(f"{round(255 * c):02x}" for c in colour)


def _half_axes(objects: ObjectMap, i: int, turn: Floats) -> list[list[float]]:
    """Return the half axes of the 2-sigma ellipsoid of object i, as vectors in the frame of the view, m.

    The list is empty if the object has no covariance. turn: the rotation from `upright`.
    """
    found = ellipsoid(objects[i])
    return [] if found is None else (turn @ (found[1] * found[0])).T.round(4).tolist()


def _body(objects: ObjectMap, i: int, turn: Floats) -> list[list[float]]:
    """Return half the length, half the width and half the height of the body of object i, as vectors in the frame of the
    view, m.

    The list is empty if the object has no body. turn: the rotation from `upright`.
    """
    body = objects[i].body
    if body is None:
        return []
    cos, sin = np.cos(body.yaw), np.sin(body.yaw)
    directions = np.array([[cos, sin, 0.0], [-sin, cos, 0.0], [0.0, 0.0, 1.0]])
    return (directions * body.size[:, None] / 2 @ turn.T).round(4).tolist()


def _thinned(truth: Truth | None, turn: Floats) -> Floats:
    if truth is None or truth.trajectory is None:
        return np.zeros((0, 3))
    way = truth.trajectory.poses[:, :3, 3] @ turn.T
    return way[evenly(len(way), _MAX_PATH)]


def _rays(objects: ObjectMap, rays: RaysTable, turn: Floats) -> dict[str, Any]:
    """Return the rays that the view draws, the used rays first. turn: the rotation from `upright`.

    The keys of the result are rays (both ends of each ray, 6 numbers, m), of (the object id of each ray) and used (the
    number of used rays).
    """
    row = {o.id: i for i, o in enumerate(objects)}
    index = np.array([row.get(int(j), -1) for j in rays.object], dtype=np.int64)
    used = (index >= 0) & (rays.weight >= REJECTED_BELOW)
    kept, out = sample(used, _MAX_USED), sample((index >= 0) & ~used, _MAX_REJECTED)
    chosen = np.concatenate([kept, out])
    chosen = chosen[np.isfinite(objects.positions[index[chosen]]).all(axis=1)] if len(chosen) else chosen
    origins = rays.origin[chosen]
    reach = np.linalg.norm(objects.positions[index[chosen]] - origins, axis=1)[:, None] if len(chosen) else np.zeros((0, 1))
    ends = origins + reach * rays.direction[chosen]
    return {
        "rays": _packed(np.hstack([origins @ turn.T, ends @ turn.T])),
        "of": rays.object[chosen].tolist(),
        "used": int(np.isin(chosen, kept).sum()),
    }


def _packed(values: Floats) -> str:
    return base64.b64encode(np.ascontiguousarray(values, dtype="<f4").tobytes()).decode()
