"""rays.parquet, the file of a result's rays: the one place that writes and reads it."""

from __future__ import annotations

import io
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from objslam.atomic_files import encode
from objslam.errors import OutputError
from objslam.types import Floats, Ints

if TYPE_CHECKING:
    from objslam.results import RunResult


@dataclass(frozen=True)
class RaysTable:
    """One row a ray: object id (R,), -1 for none; stamp (R,) s; origin (R, 3) m and direction (R, 3), unit, in map; residual
    (R,) deg, NaN without object; weight, score (R,); camera (R,) names; box (R, 4) px."""

    object: Ints
    stamp: Floats
    origin: Floats
    direction: Floats
    residual: Floats
    weight: Floats
    score: Floats
    camera: Any
    box: Floats

    def __len__(self) -> int:
        return len(self.object)


def dump_rays(result: RunResult) -> bytes:
    """The content of rays.parquet: one row a ray; object is the id in objects.json, null where none.

    OutputError where a name of a label or a camera is no text that can be written.
    """
    import pyarrow as pa
    import pyarrow.parquet as pq

    ids = np.array([o.id for o in result.map.objects] or [0], dtype=np.int64)
    index = result.association.object
    names = np.array([encode(name).decode() for name in result.rays.label_names], dtype=object)
    cameras = np.array([encode(camera.name).decode() for camera in result.cameras], dtype=object)
    table = pa.table(
        {
            "stamp": pa.array(result.keyframes.stamps[result.rays.keyframe]),
            "object": pa.array(ids[index], mask=index < 0),
            "origin": pa.FixedSizeListArray.from_arrays(pa.array(result.origins.ravel()), 3),
            "direction": pa.FixedSizeListArray.from_arrays(pa.array(result.directions.ravel()), 3),
            "residual": pa.array(result.residual, mask=np.isnan(result.residual)),
            "weight": pa.array(result.weight),
            "label": pa.array(names[result.rays.label], type=pa.string()),
            "score": pa.array(result.rays.score),
            "camera": pa.array(cameras[result.keyframes.camera[result.rays.keyframe]], type=pa.string()),
            "box": pa.FixedSizeListArray.from_arrays(pa.array(result.rays.box.ravel()), 4),
        }
    )
    buffer = io.BytesIO()
    pq.write_table(table, buffer)
    return buffer.getvalue()


def read_rays(file: Path) -> RaysTable:
    """What `dump_rays` wrote; OutputError where the file is missing, damaged, or of an older version."""
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
            residual=np.degrees(_numbers(table["residual"])),
            weight=_numbers(table["weight"]),
            score=_numbers(table["score"]),
            camera=np.array(table["camera"].to_pylist(), dtype=object),
            box=_rows(table["box"], 4),
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
