"""GeoJSON (RFC 7946): objects as points and the path as a line, for QGIS, web maps and fleet tools."""

from __future__ import annotations

import json
import math
from typing import Any

import numpy as np

from objslam.export.content import Content
from objslam.export.datum import Datum
from objslam.types import Floats, MapObject

_DEGREE_DIGITS = 9  # 0.1 mm
_METRE_DIGITS = 6


def dump(content: Content, datum: Datum | None) -> bytes:
    """The map as a FeatureCollection.

    With a datum, coordinates are WGS 84 longitude and latitude as the RFC has it, heights being properties: a map does not
    know its height above the ellipsoid. Without one they are metres in the map's frame, which the member `coordinates_in`
    says, for tools that show plane coordinates. Unresolved objects are features without a place.
    """
    features = [_object(o, datum) for o in content.objects.objects]
    if len(content.path) > 1:
        line = _coordinates(content.path.poses[:, :3, 3], datum)
        stamps = {"start": float(content.path.stamps[0]), "end": float(content.path.stamps[-1])}
        features.append(_feature({"type": "LineString", "coordinates": line}, {"kind": "path", **stamps}))
    collection: dict[str, Any] = {"type": "FeatureCollection"}
    if datum is None:
        collection["coordinates_in"] = f"metres in the frame {content.objects.frame}"
    # a line a feature, so that two files can be compared
    head, lines = json.dumps(collection)[:-1], ",\n".join(json.dumps(f, allow_nan=False) for f in features)
    return f'{head}, "features": [\n{lines}\n]}}\n'.encode()


def _object(o: MapObject, datum: Datum | None) -> dict[str, Any]:
    sigma = None if o.covariance is None else float(np.sqrt(np.linalg.eigvalsh(o.covariance)[-1]))
    properties = {
        "kind": "object",
        "label": o.label,
        "status": o.status,
        "z": _finite(o.position[2]),
        "sigma": _finite(sigma),
        "width": o.extent[0] if o.extent else None,
        "height": o.extent[1] if o.extent else None,
        "rays": o.rays,
        "first_seen": _finite(o.first_seen),
        "last_seen": _finite(o.last_seen),
        "existence": _finite(o.existence),
    }
    place = None
    if o.status == "ok":
        (coordinates,) = _coordinates(o.position[None], datum)
        place = {"type": "Point", "coordinates": coordinates}
    return {**_feature(place, properties), "id": o.id}


def _feature(geometry: dict[str, Any] | None, properties: dict[str, Any]) -> dict[str, Any]:
    return {"type": "Feature", "geometry": geometry, "properties": properties}


def _coordinates(points: Floats, datum: Datum | None) -> list[list[float]]:
    if datum is None:
        return np.round(points, _METRE_DIGITS).tolist()
    return np.round(datum.geodetic(points), _DEGREE_DIGITS).tolist()


def _finite(value: float | None) -> float | None:
    return None if value is None or not math.isfinite(value) else float(value)
