"""Represent the edges of boxes as planes through the camera that touch the body of the object."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from objslam.core.arrays import Bools, Floats, Ints
from objslam.core.camera import Camera, project, undistort
from objslam.core.geometry import lengths
from objslam.core.rotation import cross

LEFT, TOP, RIGHT, BOTTOM = range(4)
"""The indices of the edges of a box, in the order x1, y1, x2, y2."""
_STEP = 0.5
"""The step (px) of the finite differences that give the direction and the turn of an edge's plane. A larger step is less
exact in a wide lens."""
_OUTWARD = np.array([-1.0, -1.0, 1.0, 1.0])
_ACROSS = np.array([[1.0, 0.0], [0.0, 1.0], [1.0, 0.0], [0.0, 1.0]])


@dataclass(frozen=True)
class BoxEdges:
    """The four edges of B boxes as planes.

    body: (B,) the object of each box. origin: (B, 3) m, the place of the camera in map. normal: (B, 4, 3) unit normals in
    map, which point away from the box. turn: (B, 4) rad per px, by how much a plane turns if its edge moves. sigma: (B,) px,
    the noise of an edge. shift: (B,) px, the noise that moves a whole box, such as pose noise. bound: (B, 4) whether the
    object may reach farther than an edge, because the image's border cuts the object off there, or because something hides a
    part. A share between 0 and 1 says how much less an edge counts if the body reaches farther. size: (B,) px, the geometric
    mean of the sides of each box. direction: (B, 3) unit, in map, through the centre of the box. range: (B,) m along
    `direction` to the surface, NaN if unknown. range_sigma: (B,) m, the noise of the range. range_bias: (B,) m, the standard
    deviation of the error that all ranges of a body share.
    """

    body: Ints
    origin: Floats
    normal: Floats
    turn: Floats
    sigma: Floats
    shift: Floats
    bound: Bools
    size: Floats
    direction: Floats
    range: Floats
    range_sigma: Floats
    range_bias: Floats

    def __len__(self) -> int:
        return len(self.body)

    def take(self, boxes: Bools | Ints) -> BoxEdges:
        """Select boxes by a mask or by indices. The arrays of the result are stored by columns (see `by_columns`)."""
        selected: dict[str, Any] = {name: by_columns(value, boxes) for name, value in vars(self).items()}
        return replace(self, **selected)

    def joined(self, other: BoxEdges) -> BoxEdges:
        """Return these boxes, followed by the boxes of `other`."""
        both: dict[str, Any] = {name: np.concatenate([value, vars(other)[name]]) for name, value in vars(self).items()}
        return replace(self, **both)


def by_columns(rows: Any, which: Bools | Ints) -> Any:
    """Return some rows (b, ...) of an array (B, ...), stored so that each column is contiguous in memory.

    A box has few numbers of each kind. So a loop over the boxes is several times as fast as a loop over the numbers of a
    box. which: a mask (B,), or indices (b,).
    """
    return np.take(rows.T, which.nonzero()[0] if which.dtype == bool else which, axis=-1).T


def tangent_planes(
    camera: Camera, boxes: Floats, map_T_camera: Floats, contact: Floats | None = None
) -> tuple[Floats, Floats, Bools]:
    """Return the unit normals (B, 4, 3), in map, and the turns (B, 4), rad per px, of the planes of edges, and a mask (B,)
    of the boxes that have all four planes.

    boxes: (B, 4) px in the raw image. map_T_camera: (B, 4, 4). contact: (B, 4) px, where each edge touches the image of the
    body. This is y on a vertical edge, and x on a horizontal one. The default is the middle of each edge. The contact
    matters only in a distorted image. An edge is curved there, and its plane is the tangent plane at the contact.
    """
    low, high = boxes[:, :2], boxes[:, 2:]
    middle = (low + high) / 2
    if contact is None:
        contact = middle[:, [1, 0, 1, 0]]
    pixel = np.stack([boxes, contact], axis=-1)  # (x, y) for vertical edges, but (y, x) for horizontal edges.
    pixel[:, 1::2] = pixel[:, 1::2, ::-1]
    along = _ACROSS[:, ::-1] * _STEP
    parts = [pixel, pixel - along, pixel + along, pixel - _ACROSS * _STEP, pixel + _ACROSS * _STEP]
    direction, valid = undistort(camera, np.stack(parts).reshape(-1, 2))
    ray, before, after, inside, outside = direction.reshape(5, -1, 4, 3)
    normal = cross(ray, after - before)
    normal /= np.maximum(lengths(normal), 1e-12)[..., None]
    turn = np.einsum("bei,bei->be", normal, outside - inside) / (2 * _STEP)
    normal *= (np.sign(turn) * _OUTWARD)[..., None]
    good = valid.reshape(5, -1, 4).all(axis=(0, 2)) & (np.abs(turn) > 0).all(axis=1) & (high > low).all(axis=1)
    return normal @ np.swapaxes(map_T_camera[:, :3, :3], 1, 2), np.abs(turn), good


def contacts(camera: Camera, boxes: Floats, map_T_camera: Floats, touched: Floats) -> Floats:
    """Return the places (B, 4), px, at which the edges of boxes (B, 4), px, touch the image of a body.

    A place is y on a vertical edge, and x on a horizontal one. touched: (B, 4, P, 3) m in map, points at which each edge may
    touch the body. The point farthest out in the image counts. If no point is in front of the camera, the result is the
    middle of the edge. If the point lies beyond an end of the edge, the result is this end.
    """
    local = np.einsum("bij,bkpi->bkpj", map_T_camera[:, :3, :3], touched - map_T_camera[:, None, None, :3, 3])
    ahead = local[..., 2] > 0
    safe = np.where(ahead[..., None], local, [0.0, 0.0, 1.0])
    pixel = project(camera, safe.reshape(-1, 3)).reshape((*ahead.shape, 2))
    pixel[:, 1::2] = pixel[:, 1::2, :, ::-1]  # (x, y) for vertical edges, but (y, x) for horizontal edges.
    outward = np.where(ahead & np.isfinite(pixel).all(axis=3), pixel[..., 0] * _OUTWARD[:, None], -np.inf)
    best = outward.argmax(axis=2)[..., None]
    along = np.take_along_axis(pixel[..., 1], best, axis=2)[..., 0]
    ahead = np.take_along_axis(ahead, best, axis=2)[..., 0]
    low, high = boxes[:, [1, 0, 1, 0]], boxes[:, [3, 2, 3, 2]]
    return np.asarray(np.where(ahead & np.isfinite(along), np.clip(along, low, high), (low + high) / 2))
