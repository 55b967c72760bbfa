"""PLY: the resolved objects as coloured points, for MeshLab, CloudCompare and Open3D."""

from __future__ import annotations

import numpy as np

from objslam.errors import OutputError
from objslam.export.content import Content
from objslam.scene import object_colours
from objslam.types import MapObject

_PROPERTIES = (
    *(("x", "<f8", "double"), ("y", "<f8", "double"), ("z", "<f8", "double")),
    *(("red", "u1", "uchar"), ("green", "u1", "uchar"), ("blue", "u1", "uchar")),
    *(("id", "<i4", "int"), ("label", "<i4", "int"), ("sigma", "<f8", "double")),
)


def dump(content: Content) -> bytes:
    """A vertex an object: place (m), colour, id, label, and the largest standard deviation (m; 0 where unknown).

    `label` is an index into the labels that the header's comments name. OutputError where an id has no room in 32 bits.
    """
    pairs = zip(content.objects.objects, object_colours(content.objects), strict=True)
    drawn = [(o, colour) for o, colour in pairs if o.status == "ok"]
    if any(not -(2**31) <= o.id < 2**31 for o, _ in drawn):
        raise OutputError("an id of more than 32 bits, which PLY does not have", where=str(content.out))
    names = sorted({o.label for o, _ in drawn})
    rows = [
        (*o.position, *(round(255 * part) for part in colour), o.id, names.index(o.label), _sigma(o)) for o, colour in drawn
    ]
    vertices = np.array(rows, dtype=[(name, kind) for name, kind, _ in _PROPERTIES])
    header = ["ply", "format binary_little_endian 1.0", f"comment frame {_one_line(content.objects.frame)}, metres"]
    header += [f"comment label {i} {_one_line(name)}" for i, name in enumerate(names)]
    header += [
        f"element vertex {len(vertices)}",
        *(f"property {kind} {name}" for name, _, kind in _PROPERTIES),
        "end_header\n",
    ]
    return "\n".join(header).encode() + vertices.tobytes()


def _sigma(o: MapObject) -> float:
    return 0.0 if o.covariance is None else float(np.sqrt(np.linalg.eigvalsh(o.covariance)[-1]))


def _one_line(text: str) -> str:
    """Text that cannot end the comment it stands in."""
    return " ".join(text.split())
