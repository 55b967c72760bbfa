"""GeoJSON (RFC 7946): objects as points and the path as a line, for QGIS, web maps and fleet tools."""

from __future__ import annotations

import json
import math
from typing import TYPE_CHECKING, Any

from objslam.output.export.export_format import ExportFormat

if TYPE_CHECKING:
    from objslam.core.arrays import Floats
    from objslam.core.object_map import MapObject
    from objslam.output.export.content import Content
    from objslam.output.export.datum import Datum

_DEGREE_DIGITS = 9
"""Decimal places of longitudes and latitudes in degrees: 1e-9 deg is 0.1 mm on the ground."""

_METRE_DIGITS = 6
"""Decimal places of coordinates in m: a micrometre, far below any map's accuracy."""


def _dump(content: Content) -> bytes:
    """The map as a FeatureCollection.

    With a datum, coordinates are WGS 84 longitude and latitude, as the RFC asks for; heights are properties, because a map
    does not know its height above the ellipsoid. Without one, coordinates are m in the map's frame, and the member
    `coordinates_in` says so. An unresolved object is a feature without a geometry.
    """
    datum, path = content.datum, content.path
    features = [_object(o, datum) for o in content.objects.objects]
    if len(path) > 1:
        line = _coordinates(path.poses[:, :3, 3], datum)
        stamps = {"start": float(path.stamps[0]), "end": float(path.stamps[-1])}
        features.append(_feature({"type": "LineString", "coordinates": line}, {"kind": "path", **stamps}))
    collection: dict[str, Any] = {"type": "FeatureCollection"}
    if datum is None:
        collection["coordinates_in"] = f"metres in the frame {content.objects.frame}"
    # one line per feature, so that two files can be compared line by line
    head, lines = json.dumps(collection)[:-1], ",\n".join(json.dumps(f, allow_nan=False) for f in features)
    return f'{head}, "features": [\n{lines}\n]}}\n'.encode()


def _object(o: MapObject, datum: Datum | None) -> dict[str, Any]:
    properties = {
        "kind": "object",
        "label": o.label,
        "status": o.status,
        "z": _finite(o.position[2]),
        "sigma": _finite(o.sigma),
        "width": o.extent[0] if o.extent else None,
        "height": o.extent[1] if o.extent else None,
        "rays": o.rays,
        "first_seen": _finite(o.first_seen),
        "last_seen": _finite(o.last_seen),
        "existence": _finite(o.existence),
    }
    geometry = None
    if o.status == "ok":
        (coordinates,) = _coordinates(o.position[None], datum)
        geometry = {"type": "Point", "coordinates": coordinates}
    return {**_feature(geometry, properties), "id": o.id}


def _feature(geometry: dict[str, Any] | None, properties: dict[str, Any]) -> dict[str, Any]:
    return {"type": "Feature", "geometry": geometry, "properties": properties}


def _coordinates(points: Floats, datum: Datum | None) -> list[list[float]]:
    rounded = points.round(_METRE_DIGITS) if datum is None else datum.geodetic(points).round(_DEGREE_DIGITS)
    return rounded.tolist()


def _finite(value: float | None) -> float | None:
    return None if value is None or not math.isfinite(value) else float(value)


EXPORT = ExportFormat("geojson", "objects.geojson", "objects and path, for maps", _dump, takes_datum=True)
