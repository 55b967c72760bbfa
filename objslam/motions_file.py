"""motions.parquet: what the odometry measured between the poses of a result, for exports and other optimisers."""

from __future__ import annotations

import io
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from objslam.errors import OutputError
from objslam.types import Floats

if TYPE_CHECKING:
    from objslam.results import RunResult

_COLUMNS = {"before": 1, "after": 1, "motion": 16, "covariance": 36}
_TRANSLATION_FIRST = np.array([3, 4, 5, 0, 1, 2])


@dataclass(frozen=True)
class Motions:
    """Measured motions between consecutive poses of the base.

    before, after: (M,) s, the stamps of the two poses. motion: (M, 4, 4) before_T_after. covariance: (M, 6, 6), translation
    (m) first, then rotation (rad), in the frame of the pose after.
    """

    before: Floats
    after: Floats
    motion: Floats
    covariance: Floats


def motions_of(result: RunResult) -> Motions | None:
    """The odometry between the poses of trajectory.txt, None where the run used none, as in fixed mode."""
    from objslam.graph.factors import motions

    keyframes = result.keyframes
    if keyframes.odom_T_base is None:
        return None
    stamps, first = np.unique(keyframes.stamps, return_index=True)
    at = keyframes.take(first)
    at = replace(at, base_T_camera=np.broadcast_to(np.eye(4), at.base_T_camera.shape))
    motion, covariance = motions(at, result.settings)
    swapped = covariance[:, _TRANSLATION_FIRST][:, :, _TRANSLATION_FIRST]
    return Motions(stamps[:-1], stamps[1:], motion, swapped)


def dump_motions(motions: Motions) -> bytes:
    """The content of motions.parquet: a row a motion, matrices row by row."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    columns = {}
    for name, size in _COLUMNS.items():
        flat = pa.array(getattr(motions, name).reshape(-1))
        columns[name] = flat if size == 1 else pa.FixedSizeListArray.from_arrays(flat, size)
    buffer = io.BytesIO()
    pq.write_table(pa.table(columns), buffer)
    return buffer.getvalue()


def read_motions(file: Path) -> Motions:
    """What `dump_motions` wrote; OutputError where the file is not that."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    try:
        table = pq.read_table(file, columns=list(_COLUMNS))
        found = {}
        for name, size in _COLUMNS.items():
            column = table.column(name).combine_chunks()
            values = column if size == 1 else column.flatten()
            found[name] = values.to_numpy(zero_copy_only=False).astype(np.float64)
        count = table.num_rows
        motion, covariance = found["motion"].reshape(count, 4, 4), found["covariance"].reshape(count, 6, 6)
        if not all(np.isfinite(values).all() for values in found.values()):
            raise ValueError("a value is not finite")
    except (OSError, pa.ArrowException, AttributeError, KeyError, ValueError, TypeError) as error:
        raise OutputError(f"not what a run writes: {str(error).splitlines()[0][:100]}", where=str(file)) from error
    return Motions(found["before"], found["after"], motion, covariance)
