"""The reconstructed room around the objects."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import rerun as rr

from objslam.core.result import RunResult
from objslam.core.types import Surface

_MAX_VERTICES = 100_000  # The largest number of vertices in a recording, 5 MB; the whole surface has a file of its own.
_CELL = 0.02  # The edge, m, of the grid's cells before they grow.
_GROWTH = 1.25  # The factor by which the cells grow until few enough vertices remain.


def log_surfaces(recording: Any, result: RunResult) -> None:
    """`map/reconstruction/after`, and `before` where there is one; static.

    Only the front of a wall is drawn, so that the walls between the view point and the room hide nothing.
    """
    for name, surface in (("after", result.surface), ("before", result.surface_before)):
        if surface is None:
            continue
        few = coarser(surface, _MAX_VERTICES)
        mesh = rr.Mesh3D(
            vertex_positions=few.vertices,
            vertex_normals=few.normals,
            vertex_colors=few.colours,
            triangle_indices=few.triangles,
            face_rendering=rr.components.MeshFaceRendering.Front,
        )
        recording.log(f"map/reconstruction/{name}", mesh, static=True)


def coarser(surface: Surface, most: int) -> Surface:
    """A surface of at most `most` vertices: those in one cell of a grid become their mean (Rossignac & Borrel 1993)."""
    cell = _CELL
    while len(surface.vertices) > most:
        cell *= _GROWTH
        at = np.floor(surface.vertices / cell).astype(np.int64)
        at -= at.min(axis=0)
        extent = at.max(axis=0) + 1
        _, into, counts = np.unique(
            (at[:, 0] * extent[1] + at[:, 1]) * extent[2] + at[:, 2], return_inverse=True, return_counts=True
        )
        if len(counts) > most:
            continue
        triangles = into[surface.triangles].astype(np.int32)
        a, b, c = triangles.T
        normals = _sums(surface.normals, into, len(counts))
        colours = surface.colours
        if colours is not None:
            colours = (_sums(colours, into, len(counts)) / counts[:, None]).round().astype(np.uint8)
        few = Surface(
            vertices=(_sums(surface.vertices, into, len(counts)) / counts[:, None]).astype(np.float32),
            normals=(normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-9)).astype(np.float32),
            colours=colours,
            triangles=triangles[(a != b) & (b != c) & (c != a)],
        )
        return _not_turned(few)
    return surface


def _not_turned(surface: Surface) -> Surface:
    """The surface without triangles that were turned over, which happens where something thin fell into one cell."""
    a, b, c = (surface.vertices[corner] for corner in surface.triangles.T)
    normal = surface.normals[surface.triangles].sum(axis=1)
    right = np.einsum("ti,ti->t", np.cross(b - a, c - a), normal) > 0
    return replace(surface, triangles=surface.triangles[right])


def _sums(values: Any, into: Any, count: int) -> Any:
    return np.stack([np.bincount(into, column, count) for column in np.asarray(values, dtype=np.float64).T], axis=1)
