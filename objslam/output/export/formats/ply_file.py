"""The PLY format: the resolved objects as coloured points, for MeshLab, CloudCompare and Open3D."""

from __future__ import annotations

from typing import TYPE_CHECKING

from objslam.errors import OutputError
from objslam.output.export.export_format import ExportFormat

if TYPE_CHECKING:
    from objslam.output.export.content import Content

_PROPERTIES = (
    *(("x", "<f8", "double"), ("y", "<f8", "double"), ("z", "<f8", "double")),
    *(("red", "u1", "uchar"), ("green", "u1", "uchar"), ("blue", "u1", "uchar")),
    *(("id", "<i4", "int"), ("label", "<i4", "int"), ("sigma", "<f8", "double")),
)
"""The name, the numpy type and the PLY type of each property."""


def _dump(content: Content) -> bytes:
    """Return a PLY file with a vertex for each resolved object: position (m), colour, id, label and sigma.

    `label` is an index into the labels that the header's comments list. `sigma` is the standard deviation along the least
    certain direction (m), or 0 if it is unknown.
    """
    import numpy as np

    from objslam.output.plot.style import object_colours

    pairs = zip(content.objects.objects, object_colours(content.objects), strict=True)
    drawn = [(o, colour) for o, colour in pairs if o.status == "ok"]
    if any(not -(2**31) <= o.id < 2**31 for o, _ in drawn):
        raise OutputError("an object id needs more than 32 bits, and PLY has no such integers", where=str(content.out))
    names = sorted({o.label for o, _ in drawn})
    rows = [(*o.position, *(round(255 * c) for c in rgb), o.id, names.index(o.label), o.sigma or 0.0) for o, rgb in drawn]
    vertices = np.array(rows, dtype=[(name, kind) for name, kind, _ in _PROPERTIES])
    # A line break ends a PLY comment, so all texts are joined to one line.
    header = ["ply", "format binary_little_endian 1.0", f"comment frame {' '.join(content.objects.frame.split())}, metres"]
    header += [f"comment label {i} {' '.join(name.split())}" for i, name in enumerate(names)]
    header.append(f"element vertex {len(vertices)}")
    header += [f"property {kind} {name}" for name, _, kind in _PROPERTIES]
    return "\n".join([*header, "end_header\n"]).encode() + vertices.tobytes()


EXPORT = ExportFormat("ply", "objects.ply", "objects as points", _dump)
