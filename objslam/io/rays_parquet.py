"""Read and write rays.parquet, the file with the rays of a result."""

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
    """All rays of a result, with one row per ray."""

    object: Ints  # (R,) object id, -1 for an unassigned ray.
    stamp: Floats  # (R,) timestamp, s.
    origin: Floats  # (R, 3) m, in map.
    direction: Floats  # (R, 3) unit vector, in map.
    residual: Floats  # (R,) angle between ray and object, rad, NaN for an unassigned ray.
    weight: Floats  # (R,) robust weight, in [0, 1].
    score: Floats  # (R,) score of the box.
    camera: Any  # (R,) camera name.
    box: Floats  # (R, 4) x1, y1, x2, y2, px of the raw image.
    label: Any  # (R,) label of the box.
    sigma: Floats  # (R,) standard deviation of the residual along one axis by the settings, rad.
    residual_before: Floats  # (R,) residual with the shared errors left in, rad, NaN if they were not estimated.
    image: Floats  # (R, 2) centre of the box, as a share of the image's width and height.
    speed: Floats  # (R,) speed of the robot, m/s.
    turn_rate: Floats  # (R,) turn rate of the robot to the left, rad/s.

    def __len__(self) -> int:
        return len(self.object)


def dump_rays(rays: RaysTable) -> bytes:
    """Return the content of rays.parquet. Object -1 and NaN residuals become null. Raises OutputError for invalid text."""
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
            "sigma": pa.array(rays.sigma),
            "residual_before": pa.array(rays.residual_before, mask=np.isnan(rays.residual_before)),
            "image": lists(rays.image),
            "speed": pa.array(rays.speed),
            "turn_rate": pa.array(rays.turn_rate),
        }
    )
    buffer = io.BytesIO()
    pq.write_table(table, buffer)
    return buffer.getvalue()


def read_rays(file: Path) -> RaysTable:
    """Read a rays.parquet. Raises OutputError if the file is missing, damaged or from an older version."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    def numbers(name: str) -> Floats:
        return np.asarray(table[name].to_numpy(), dtype=np.float64)

    def rows(name: str, length: int) -> Floats:
        return np.asarray(table[name].combine_chunks().flatten().to_numpy(), dtype=np.float64).reshape(-1, length)

    try:
        table = pq.read_table(file)
        index = table["object"]
        return RaysTable(
            object=np.where(index.is_null(), -1, index.fill_null(-1).to_numpy()).astype(np.int64),
            stamp=numbers("stamp"),
            origin=rows("origin", 3),
            direction=rows("direction", 3),
            residual=numbers("residual"),
            weight=numbers("weight"),
            score=numbers("score"),
            camera=np.array(table["camera"].to_pylist(), dtype=object),
            box=rows("box", 4),
            label=np.array(table["label"].to_pylist(), dtype=object),
            sigma=numbers("sigma"),
            residual_before=numbers("residual_before"),
            image=rows("image", 2),
            speed=numbers("speed"),
            turn_rate=numbers("turn_rate"),
        )
    except OSError as error:
        raise OutputError(f"cannot be read: {error.strerror or error}", where=str(file)) from error
    except KeyError as error:
        raise OutputError(f"the column {error} is missing", where=str(file), hint="run again") from error
    except (pa.ArrowException, ValueError) as error:
        raise OutputError(f"is damaged: {str(error).splitlines()[0]}", where=str(file), hint="run again") from error
