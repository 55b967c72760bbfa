"""The tables of a fleet: sessions, objects and failures. They are Parquet files, which DuckDB, pandas, QGIS and Spark can
read.

The objects are GeoParquet 1.1 points (https://geoparquet.org/releases/v1.1.0/). They are in the metric frame of their site,
which has no coordinate reference system.
"""

from __future__ import annotations

import io
import json
from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from objslam.core.object_map import COLUMNS, MapObject
from objslam.fleet.record import Record

if TYPE_CHECKING:
    import pyarrow as pa

    from objslam.core.arrays import Floats

_POINT_Z = 1001  # The code of a 3D point in the ISO form of well-known binary.
_WKB = np.dtype([("order", "u1"), ("kind", "<u4"), ("place", "<f8", 3)])  # The layout of one point, little endian.


def session_schema() -> pa.Schema:
    """Return the schema of the table of sessions.

    Stamps, seconds and cpu are in s, memory and size in bytes, x, y and z in m, and yaw in rad. cost is in the currency of
    the price.
    """
    import pyarrow as pa

    parameter = pa.struct([("name", pa.string()), ("value", pa.float64()), ("sigma", pa.float64())])
    parameter = pa.struct([*parameter, ("unit", pa.string()), ("known", pa.bool_())])
    text, number, count = pa.string(), pa.float64(), pa.int64()
    return pa.schema(
        [
            *((name, text) for name in ("session", "source", "robot", "log", "settings", "version", "mode", "verdict")),
            *((name, count) for name in ("island", "objects", "unresolved", "keyframes", "rays", "detections")),
            *((name, number) for name in ("begin", "end", "x", "y", "z", "yaw", "log_odds")),
            ("common_objects", count),
            ("calibration", pa.list_(parameter)),
            ("warnings", pa.list_(text)),
            *((name, number) for name in ("seconds", "cpu", "cost")),
            *((name, count) for name in ("memory", "size")),
        ]
    )


def session_row(
    record: Record, robot: str, island: int, pose: Floats, odds: float, common: int, price: float
) -> dict[str, Any]:
    """Return the row of a session in the table of sessions.

    robot: the name of the robot. island: the number, from 1 on, of the session's group of sessions that share objects. pose:
    (4, 4) the pose of the session in the frame of this group, m. odds, common: the `log_odds` and `common` of `Placed`.
    price: the price of one hour of one core, NaN if unknown.
    """
    counts = record.counts or {}
    return {
        **{name: getattr(record, name) for name in ("source", "log", "settings", "version", "mode", "verdict")},
        **{name: getattr(record, name) for name in ("begin", "end", "seconds", "cpu", "memory", "size")},
        **{name: counts.get(name) for name in ("objects", "unresolved", "keyframes", "rays", "detections")},
        **dict(zip("xyz", pose[:3, 3].tolist(), strict=True)),
        **{"session": record.key, "robot": robot, "island": island, "common_objects": common},
        "yaw": float(np.arctan2(pose[1, 0], pose[0, 0])),
        "log_odds": odds if np.isfinite(odds) else None,
        "calibration": [{name: getattr(one, name) for name in one.__slots__} for one in record.calibration],
        "warnings": list(record.warnings),
        "cost": record.seconds / 3600 * price if np.isfinite(price) else None,
    }


def object_rows(objects: Iterable[MapObject], frame_T_map: Floats, more: dict[str, Any]) -> list[dict[str, Any]]:
    """Return one row for each object, with the object moved to another frame. frame_T_map: (4, 4) takes points from the map
    of the objects to this frame. more: the columns that all rows share."""
    turn, rows = frame_T_map[:3, :3], []
    for o in objects:
        row = {**more, **o.row()}
        place = turn @ o.position + frame_T_map[:3, 3]
        row |= {name: float(v) if np.isfinite(v) else None for name, v in zip("xyz", place, strict=True)}
        if o.covariance is not None:
            spread = turn @ o.covariance @ turn.T
            row |= {f"cov_{'xyz'[i]}{'xyz'[k]}": float(spread[i, k]) for i in range(3) for k in range(i, 3)}
        if o.life is not None and o.life.moved_from is not None:
            before = turn @ o.life.moved_from + frame_T_map[:3, 3]
            row |= {f"moved_from_{name}": float(value) for name, value in zip("xyz", before, strict=True)}
        rows.append(row)
    return rows


def dump_sessions(rows: Sequence[dict[str, Any]]) -> bytes:
    """Return the content of a Parquet file with the rows of sessions."""
    import pyarrow as pa

    return _parquet(pa.Table.from_pylist(list(rows), session_schema()))


def dump_objects(rows: Sequence[dict[str, Any]], *, lives: bool = False) -> bytes:
    """Return the content of a GeoParquet file with the rows of objects. The geometry of an unresolved object is null.

    lives: whether the objects are those of a merged site. Their rows have no columns session, source and robot.
    """
    import pyarrow as pa

    text = ("session", "source", "robot")
    columns = [("island", pa.int64()), *(() if lives else ((name, pa.string()) for name in text))]
    columns += [(name, pa.type_for_alias(kind)) for name, kind in COLUMNS.items()]
    table = pa.Table.from_pylist(list(rows), pa.schema(columns))
    places = np.array([[np.nan if row[name] is None else row[name] for name in "xyz"] for row in rows]).reshape(-1, 3)
    known = np.isfinite(places).all(axis=1) & np.array([row["status"] == "ok" for row in rows], dtype=bool)
    table = table.add_column(0, "geometry", _points(places, known))
    column: dict[str, Any] = {"encoding": "WKB", "geometry_types": ["Point Z"] if known.any() else [], "crs": None}
    if known.any():
        column["bbox"] = [*places[known].min(axis=0).tolist(), *places[known].max(axis=0).tolist()]
    geo = {"version": "1.1.0", "primary_column": "geometry", "columns": {"geometry": column}}
    return _parquet(table.replace_schema_metadata({"geo": json.dumps(geo)}))


def dump_failures(rows: Sequence[dict[str, Any]]) -> bytes:
    """Return the content of failed.parquet, with the columns source, site, robot, day, kind and error."""
    import pyarrow as pa

    names = ("source", "site", "robot", "day", "kind", "error")
    return _parquet(pa.Table.from_pylist(list(rows), pa.schema([(name, pa.string()) for name in names])))


def _points(places: Floats, known: Any) -> pa.Array:
    import pyarrow as pa

    wkb = np.zeros(int(known.sum()), dtype=_WKB)
    wkb["order"], wkb["kind"], wkb["place"] = 1, _POINT_Z, places[known]
    offsets = np.concatenate([[0], np.cumsum(np.where(known, _WKB.itemsize, 0))]).astype(np.int32)
    valid = pa.array(known).buffers()[1] if len(known) else None
    return pa.Array.from_buffers(pa.binary(), len(known), [valid, pa.py_buffer(offsets), pa.py_buffer(wkb.tobytes())])


def _parquet(table: pa.Table) -> bytes:
    import pyarrow.parquet as pq

    buffer = io.BytesIO()
    pq.write_table(table, buffer, compression="zstd")
    return buffer.getvalue()
