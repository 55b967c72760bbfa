"""rays.parquet read back."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from objslam.errors import OutputError
from objslam.results import RAYS
from objslam.types import Floats, Ints


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


def read_rays(out: Path) -> RaysTable:
    """The rays of the result in the folder `out`; OutputError where the file is missing, damaged, or of an older version."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    file = out / RAYS
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
