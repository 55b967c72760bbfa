"""The reconstructed room under the objects."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from objslam.types import Surface

if TYPE_CHECKING:
    from objslam.results import RunResult

_MOST = 100_000  # vertices: 5 MB of a recording; the whole surface is in a file of its own
_FIRST, _WIDER = 0.02, 1.25  # m, and times that until there are few enough


def log_surfaces(recording: Any, result: RunResult) -> None:
    """`map/reconstruction/after`, and `before` where there is one, static; seen from its front alone, so that the walls
    between the eye and a room hide nothing."""
    import rerun as rr

    for name, surface in (("after", result.surface), ("before", result.surface_before)):
        if surface is None:
            continue
        few = coarser(surface, _MOST)
        mesh = rr.Mesh3D(
            vertex_positions=few.vertices,
            vertex_normals=few.normals,
            vertex_colors=few.colours,
            triangle_indices=few.triangles,
            face_rendering=rr.components.MeshFaceRendering.Front,
        )
        recording.log(f"map/reconstruction/{name}", mesh, static=True)


def coarser(surface: Surface, most: int) -> Surface:
    """The surface with at most so many vertices: those in one cell of a grid become their mean (Rossignac & Borrel 1993)."""
    cell = _FIRST
    while len(surface.vertices) > most:
        cell *= _WIDER
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
        few = Surface(
            vertices=(_sums(surface.vertices, into, len(counts)) / counts[:, None]).astype(np.float32),
            normals=(normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-9)).astype(np.float32),
            colours=None
            if surface.colours is None
            else (_sums(surface.colours, into, len(counts)) / counts[:, None]).round().astype(np.uint8),
            triangles=triangles[(a != b) & (b != c) & (c != a)],
        )
        return _not_turned(few)
    return surface


def _not_turned(surface: Surface) -> Surface:
    """Without the triangles that were turned over: where both sides of something thin fell into one cell."""
    a, b, c = (surface.vertices[corner] for corner in surface.triangles.T)
    normal = surface.normals[surface.triangles].sum(axis=1)
    right = np.einsum("ti,ti->t", np.cross(b - a, c - a), normal) > 0
    return replace(surface, triangles=surface.triangles[right])


def _sums(values: Any, into: Any, count: int) -> Any:
    return np.stack([np.bincount(into, column, count) for column in np.asarray(values, dtype=np.float64).T], axis=1)
