"""Write surfaces as PLY files (binary, little endian) for MeshLab, CloudCompare, Blender and Open3D."""

from pathlib import Path

import numpy as np

from objslam.core.result import Surface


def write_mesh(surface: Surface, file: Path) -> None:
    """Write the vertices (m, in map), colours and triangles of a surface. Raises OSError if the file cannot be written."""
    _write(surface, file, triangles=True)


def write_cloud(surface: Surface, file: Path) -> None:
    """Write the vertices (m, in map), normals and colours of a surface. Raises OSError if the file cannot be written."""
    _write(surface, file, triangles=False)


def _write(surface: Surface, file: Path, *, triangles: bool) -> None:
    columns = {"x y z": surface.vertices.astype("<f4")}
    if not triangles:
        columns["nx ny nz"] = surface.normals.astype("<f4")
    if surface.colours is not None:
        columns["red green blue"] = surface.colours
    fields = [(name, values.dtype.str) for names, values in columns.items() for name in names.split()]
    vertices = np.empty(len(surface.vertices), dtype=fields)
    for names, values in columns.items():
        for i, name in enumerate(names.split()):
            vertices[name] = values[:, i]
    header = ["ply", "format binary_little_endian 1.0", "comment frame map, metres", f"element vertex {len(vertices)}"]
    header += [f"property {'uchar' if kind == '|u1' else 'float'} {name}" for name, kind in fields]
    with file.open("wb") as stream:
        if triangles:
            faces = np.empty(len(surface.triangles), dtype=[("count", "u1"), ("index", "<i4", 3)])
            faces["count"], faces["index"] = 3, surface.triangles
            header += [f"element face {len(faces)}", "property list uchar int vertex_indices"]
        stream.write("\n".join([*header, "end_header\n"]).encode())
        stream.write(vertices.tobytes())
        if triangles:
            stream.write(faces.tobytes())
