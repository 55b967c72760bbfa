"""rays.parquet, the file of a result's rays: the one place that writes and reads it."""

from __future__ import annotations

import io
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from objslam.core.arrays import Floats, Ints
from objslam.errors import OutputError
from objslam.io.atomic_files import encode


@dataclass(frozen=True)
class RaysTable:
    """All rays of a result, one row each."""

    object: Ints  # (R,) the object's id; -1 for none.
    stamp: Floats  # (R,) s.
    origin: Floats  # (R, 3) m in map.
    direction: Floats  # (R, 3) unit vectors in map.
    residual: Floats  # (R,) rad, the angle of the object off its ray; NaN without object.
    weight: Floats  # (R,) the robust weight, in [0, 1].
    score: Floats  # (R,) that of the box.
    camera: Any  # (R,) names.
    box: Floats  # (R, 4) x1, y1, x2, y2 in px of the raw image.
    label: Any  # (R,) the label of the box.

    def __len__(self) -> int:
        return len(self.object)


def dump_rays(rays: RaysTable) -> bytes:
    """The content of rays.parquet; an object of -1 and a residual of NaN become null.

    Raises:
        OutputError: a label or the name of a camera is no text that a file can hold.
    """
    import pyarrow as pa
    import pyarrow.parquet as pq

    def lists(rows: Floats) -> pa.Array:
        return pa.FixedSizeListArray.from_arrays(pa.array(rows.ravel()), rows.shape[1])

    def texts(names: Any) -> pa.Array:
        for name in set(names):
            encode(name)
        return pa.array(names, type=pa.string())

    table = pa.table(
        {
            "stamp": pa.array(rays.stamp),
            "object": pa.array(rays.object, mask=rays.object < 0),
            "origin": lists(rays.origin),
            "direction": lists(rays.direction),
            "residual": pa.array(rays.residual, mask=np.isnan(rays.residual)),
            "weight": pa.array(rays.weight),
            "label": texts(rays.label),
            "score": pa.array(rays.score),
            "camera": texts(rays.camera),
            "box": lists(rays.box),
        }
    )
    buffer = io.BytesIO()
    pq.write_table(table, buffer)
    return buffer.getvalue()


def read_rays(file: Path) -> RaysTable:
    """The rays that `dump_rays` wrote; OutputError where the file is missing, damaged, or of an older version."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    try:
        table = pq.read_table(file)
        index = table["object"]
        return RaysTable(
            object=np.where(index.is_null(), -1, index.fill_null(-1).to_numpy()).astype(np.int64),
            stamp=_numbers(table["stamp"]),
            origin=_rows(table["origin"], 3),
            direction=_rows(table["direction"], 3),
            residual=_numbers(table["residual"]),
            weight=_numbers(table["weight"]),
            score=_numbers(table["score"]),
            camera=np.array(table["camera"].to_pylist(), dtype=object),
            box=_rows(table["box"], 4),
            label=np.array(table["label"].to_pylist(), dtype=object),
        )
    except OSError as error:
        raise OutputError(f"cannot be read: {error.strerror or error}", where=str(file)) from error
    except KeyError as error:
        raise OutputError(f"there is no column {error}", where=str(file), hint="run again") from error
    except (pa.ArrowException, ValueError) as error:
        raise OutputError(f"is damaged: {str(error).splitlines()[0]}", where=str(file), hint="run again") from error


def _rows(column: Any, length: int) -> Floats:
    return _numbers(column.combine_chunks().flatten()).reshape(-1, length)


def _numbers(column: Any) -> Floats:
    return np.asarray(column.to_numpy(), dtype=np.float64)
