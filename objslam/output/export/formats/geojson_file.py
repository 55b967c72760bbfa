"""The GeoJSON format (RFC 7946): objects as points, their footprints, and the path as a line, for QGIS and others."""

from __future__ import annotations

import json
import math
from typing import TYPE_CHECKING, Any

from objslam.output.export.export_format import ExportFormat

if TYPE_CHECKING:
    from objslam.core.arrays import Floats
    from objslam.core.object_map import MapObject
    from objslam.output.export.content import Content, Datum

_DEGREE_DIGITS = 9  # The number of decimal places of longitudes and latitudes, deg. 1e-9 deg is 0.1 mm on the ground.
_METRE_DIGITS = 6  # The number of decimal places of coordinates, m. 1e-6 m is far below the error of any map.


def _dump(content: Content) -> bytes:
    """Return the map as a FeatureCollection.

    With a datum, coordinates are WGS 84 longitude and latitude, as the RFC requires. Without a datum, coordinates are in m,
    in the map's frame, and the member `coordinates_in` names this frame. Heights are properties, because the height of a map
    above the ellipsoid is unknown. An object with a body has a second feature, its footprint. An unresolved object is a
    feature without a geometry. In the map of a site, each object has its `state`, and objects that are gone are included.
    """
    datum, path = content.datum, content.path
    features = [_object(o, datum) for o in (*content.objects.objects, *content.objects.gone)]
    if len(path) > 1:
        geometry = {"type": "LineString", "coordinates": _coordinates(path.poses[:, :3, 3], datum)}
        properties = {"kind": "path", "start": float(path.stamps[0]), "end": float(path.stamps[-1])}
        features.append({"type": "Feature", "geometry": geometry, "properties": properties})
    features += [footprint for o in content.objects.objects if (footprint := _footprint(o, datum))]
    collection: dict[str, Any] = {"type": "FeatureCollection"}
    if datum is None:
        collection["coordinates_in"] = f"metres in the frame {content.objects.frame}"
    # Each feature has its own line, so that two files can be compared line by line.
    head, lines = json.dumps(collection)[:-1], ",\n".join(json.dumps(f, allow_nan=False) for f in features)
    return f'{head}, "features": [\n{lines}\n]}}\n'.encode()


def _object(o: MapObject, datum: Datum | None) -> dict[str, Any]:
    width, height = o.extent or (None, None)
    properties: dict[str, Any] = {"kind": "object", "label": o.label, "status": o.status}
    properties |= {"z": _finite(o.position[2]), "sigma": _finite(o.sigma), "width": width, "height": height, "rays": o.rays}
    properties |= {name: _finite(getattr(o, name)) for name in ("first_seen", "last_seen", "existence")}
    geometry: dict[str, Any] | None = None
    if o.body is not None:
        properties |= {"shape": o.body.shape, "size": o.body.size.tolist(), "yaw": o.body.yaw}
    if o.life is not None:
        properties |= {
            name: getattr(o.life, name) for name in ("state", "probability", "sessions_expected", "sessions_seen")
        }
        properties |= {"updated": _finite(o.life.updated)}
    if o.status == "ok":
        geometry = {"type": "Point", "coordinates": _coordinates(o.position[None], datum)[0]}
    return {"type": "Feature", "geometry": geometry, "properties": properties, "id": o.id}


def _footprint(o: MapObject, datum: Datum | None) -> dict[str, Any] | None:
    """Return the footprint of an object's body, as map.png draws it. Return None if the body has no outline.

    The corners are in counter-clockwise order. The last corner repeats the first, as the RFC requires.
    """
    import numpy as np

    from objslam.output.plot.style import body_outline

    outline = body_outline(o)
    if outline is None:
        return None
    outline[-1] = outline[0]
    ring = np.column_stack([outline, np.full(len(outline), o.position[2])])
    geometry = {"type": "Polygon", "coordinates": [_coordinates(ring, datum)]}
    return {"type": "Feature", "geometry": geometry, "properties": {"kind": "footprint", "object": o.id, "label": o.label}}


def _coordinates(points: Floats, datum: Datum | None) -> list[list[float]]:
    rounded = points.round(_METRE_DIGITS) if datum is None else datum.geodetic(points).round(_DEGREE_DIGITS)
    return rounded.tolist()


def _finite(value: float | None) -> float | None:
    return None if value is None or not math.isfinite(value) else float(value)


EXPORT = ExportFormat("geojson", "objects.geojson", "objects and path, for maps", _dump, takes_datum=True)
