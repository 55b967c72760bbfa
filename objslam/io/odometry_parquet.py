"""Read and write motions.parquet, the odometry between the poses of a result. Exports and other optimisers use this file."""

import io
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from objslam.core.arrays import Floats
from objslam.core.validity import covariance_fault, rigid_poses, valid_stamps
from objslam.errors import OutputError

_COLUMNS = {"before": 1, "after": 1, "motion": 16, "covariance": 36}  # How many numbers each column has in a row.


@dataclass(frozen=True)
class Motions:
    """The measured motions between consecutive poses of the base."""

    before: Floats  # (M,) timestamp of the first pose, s.
    after: Floats  # (M,) timestamp of the second pose, s.
    motion: Floats  # (M, 4, 4) before_T_after.
    covariance: Floats  # (M, 6, 6) of the motion: translation (m), then rotation (rad), in the base frame at `after`.


def dump_motions(motions: Motions) -> bytes:
    """Return the content of motions.parquet. Each motion is one row, and matrices are in row-major order."""
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
    """Read a motions.parquet. Raises OutputError for any other content."""
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
        if not all(len(values) == count * size for values, size in zip(found.values(), _COLUMNS.values(), strict=True)):
            raise ValueError("a column has empty cells")
        motion, rigid = rigid_poses(motion)
        if not rigid.all():
            raise ValueError("a motion is not a rigid pose")
        if (fault := covariance_fault(covariance)) is not None:
            raise ValueError(f"a covariance {fault}")
        if not (valid_stamps(found["before"]) & (found["before"] < found["after"]) & valid_stamps(found["after"])).all():
            raise ValueError("a motion does not lead from an earlier stamp to a later one")
    except (OSError, pa.ArrowException, AttributeError, KeyError, ValueError, TypeError) as error:
        raise OutputError(f"not what a run writes: {str(error).splitlines()[0][:100]}", where=str(file)) from error
    return Motions(found["before"], found["after"], motion, covariance)
