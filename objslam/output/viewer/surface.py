"""The reconstructed surface of the room."""

from typing import Any

import numpy as np
import rerun as rr

from objslam.core.result import RunResult, Surface

_MAX_VERTICES = 100_000  # The most vertices of a recorded surface, 5 MB. reconstruction.ply has all vertices.
_CELL = 0.02  # The edge length, m, from which the grid cells grow. The first cells have `_GROWTH` times this length.
_GROWTH = 1.25  # The factor by which cells grow until at most `_MAX_VERTICES` vertices are left.


def log_surfaces(recording: Any, result: RunResult) -> None:
    """Log the static surfaces `after` and `before` the estimation of the poses, if they exist, to `map/reconstruction`.

    Only the front of a wall is drawn, so that walls near the view point do not hide the room.
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
    """Return a surface with at most `most` vertices. The vertices in a grid cell become their mean (Rossignac & Borrel
    1993)."""
    cell = _CELL
    while len(surface.vertices) > most:
        cell *= _GROWTH
        at = np.floor(surface.vertices / cell).astype(np.int64)
        at -= at.min(axis=0)
        extent = at.max(axis=0) + 1
        cells = (at[:, 0] * extent[1] + at[:, 1]) * extent[2] + at[:, 2]
        _, into, counts = np.unique(cells, return_inverse=True, return_counts=True)
        if len(counts) > most:
            continue
        triangles = into[surface.triangles].astype(np.int32)
        a, b, c = triangles.T
        triangles = triangles[(a != b) & (b != c) & (c != a)]
        vertices = (_sums(surface.vertices, into, len(counts)) / counts[:, None]).astype(np.float32)
        normals = _sums(surface.normals, into, len(counts))
        normals = (normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-9)).astype(np.float32)
        colours = surface.colours
        if colours is not None:
            colours = (_sums(colours, into, len(counts)) / counts[:, None]).round().astype(np.uint8)
        # If both sides of a thin part fall into one cell, triangles can flip. Flipped triangles are removed.
        a, b, c = (vertices[corner] for corner in triangles.T)
        upright = np.einsum("ti,ti->t", np.cross(b - a, c - a), normals[triangles].sum(axis=1)) > 0
        return Surface(vertices=vertices, normals=normals, colours=colours, triangles=triangles[upright])
    return surface


def _sums(values: Any, into: Any, count: int) -> Any:
    """Return the sums (count, C) of values (N, C) by group. into: (N,) the group of each row."""
    return np.stack([np.bincount(into, column, count) for column in np.asarray(values, dtype=np.float64).T], axis=1)
