"""Read and write rays.parquet, the rays of a result, and features.parquet, the appearance vectors of these rays."""

import io
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from objslam.core.appearance.features import are_unit_vectors
from objslam.core.arrays import Floats, Floats32, Ints
from objslam.core.validity import MAX_POSITION, box_rules, lengths, valid_depths, valid_positions, valid_stamps
from objslam.errors import OutputError, first_line
from objslam.io.atomic_files import encode
from objslam.io.tables import arrow_table, to_pandas

if TYPE_CHECKING:
    import pandas as pd
    import pyarrow as pa

_NUMBERS = {
    "stamp": 1,
    "frame_stamp": 1,
    "origin": 3,
    "direction": 3,
    "residual": 1,
    "weight": 1,
    "score": 1,
    "box": 4,
    "sigma": 1,
}
_NUMBERS |= {"residual_before": 1, "image": 2, "speed": 1, "turn_rate": 1}  # How many numbers each column has in a row.
_LATER = {"frame_stamp": "stamp"}  # The columns that older files do not have, and the column that is read instead.
_UNIT = 1e-3  # The largest difference between the length of a direction and 1. A larger value accepts worse directions.


@dataclass(frozen=True, eq=False, repr=False)
class RaysTable:
    """All rays of a result, with one row per ray."""

    object: Ints  # (R,) object id, -1 for an unassigned ray.
    stamp: Floats  # (R,) timestamp, s, on the clock of the poses.
    frame_stamp: Floats  # (R,) timestamp of the frame in the log, s, before any correction of a clock.
    origin: Floats  # (R, 3) m, in map.
    direction: Floats  # (R, 3) unit vector, in map.
    residual: Floats  # (R,) angle between ray and object, rad, NaN for an unassigned ray.
    weight: Floats  # (R,) robust weight, in [0, 1].
    score: Floats  # (R,) score of the box.
    camera: Any  # (R,) camera name.
    box: Floats  # (R, 4) x1, y1, x2, y2, px of the raw image.
    label: Any  # (R,) label of the box.
    sigma: Floats  # (R,) standard deviation of the residual along one axis, from the settings, rad.
    residual_before: Floats  # (R,) residual before the correction of the shared errors, rad. NaN without a correction.
    image: Floats  # (R, 2) centre x, y of the box, as shares of the image's width and height.
    speed: Floats  # (R,) speed of the robot, m/s.
    turn_rate: Floats  # (R,) turn rate of the robot to the left, rad/s.

    def __len__(self) -> int:
        return len(self.object)

    def __repr__(self) -> str:
        return f"RaysTable of {len(self)} rays, {int((self.object < 0).sum())} of no object"

    def to_arrow(self) -> "pa.Table":
        """Return the rays as a pyarrow table with the columns of rays.parquet. Object -1 and NaN residuals become null."""
        import pyarrow as pa

        return arrow_table(
            {
                "stamp": self.stamp,
                "frame_stamp": self.frame_stamp,
                "object": pa.array(self.object, mask=self.object < 0),
                "origin": self.origin,
                "direction": self.direction,
                "residual": pa.array(self.residual, mask=np.isnan(self.residual)),
                "weight": self.weight,
                "label": pa.array(self.label, type=pa.string()),
                "score": self.score,
                "camera": pa.array(self.camera, type=pa.string()),
                "box": self.box,
                "sigma": self.sigma,
                "residual_before": pa.array(self.residual_before, mask=np.isnan(self.residual_before)),
                "image": self.image,
                "speed": self.speed,
                "turn_rate": self.turn_rate,
            }
        )

    def to_pandas(self) -> "pd.DataFrame":
        """Return the rays as a pandas data frame. Raises ObjslamError if pandas is not installed."""
        return to_pandas(self.to_arrow())


def dump_rays(rays: RaysTable) -> bytes:
    """Return the content of rays.parquet. Object -1 and NaN residuals become null.

    Raises OutputError for a label or a camera name that UTF-8 cannot represent.
    """
    import pyarrow.parquet as pq

    for name in {*rays.label, *rays.camera}:
        encode(name)
    buffer = io.BytesIO()
    pq.write_table(rays.to_arrow(), buffer)
    return buffer.getvalue()


def read_rays(file: Path) -> RaysTable:
    """Read a rays.parquet. Raises OutputError if the file is missing or damaged, lacks a column, or has invalid values."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    try:
        table = pq.read_table(file, partitioning=None)
        there = {name: name if name in table.column_names else _LATER.get(name, name) for name in _NUMBERS}
        columns = {name: _column(table, there[name], size) for name, size in _NUMBERS.items()}
        columns |= {name: _texts(table, name) for name in ("camera", "label")}
        index = table["object"]
        if not pa.types.is_integer(index.type):
            raise ValueError("the column object holds no integers")
        number = np.where(index.is_null(), -1, index.fill_null(-1).to_numpy()).astype(np.int64)
        rays = RaysTable(object=number, **columns)
    except OSError as error:
        raise OutputError(f"cannot be read: {error.strerror or error}", where=str(file)) from error
    except KeyError as error:
        raise OutputError(f"the column {error} is missing", where=str(file), hint="run again") from error
    except (pa.ArrowException, ValueError) as error:
        raise OutputError(f"is damaged: {first_line(error)}", where=str(file), hint="run again") from error
    if (fault := _fault(rays)) is not None:
        raise OutputError(f"not what a run writes: a ray with {fault}", where=str(file), hint="run again")
    return rays


def _column(table: Any, name: str, size: int) -> Floats:
    """Return the numbers of a column, (R,) if `size` is 1, else (R, size). An empty cell of single numbers is NaN.

    Raises ValueError if a row does not have `size` numbers.
    """
    import pyarrow as pa
    import pyarrow.compute as pc

    column = table[name].combine_chunks()
    kind = column.type if size == 1 else getattr(column.type, "value_type", pa.null())
    if not pa.types.is_floating(kind):
        raise ValueError(f"the column {name} does not have {size} numbers in each row")
    if size > 1 and (np.asarray(pc.list_value_length(column).fill_null(0)) != size).any():
        raise ValueError(f"the column {name} does not have {size} numbers in each row")
    values = np.asarray((column if size == 1 else column.flatten()).to_numpy(zero_copy_only=False), dtype=np.float64)
    return values if size == 1 else values.reshape(-1, size)


def _texts(table: Any, name: str) -> Any:
    texts = table[name].to_pylist()
    if not all(isinstance(text, str) for text in texts):
        raise ValueError(f"the column {name} holds something else than texts")
    return np.array(texts, dtype=object)


def _fault(rays: RaysTable) -> str | None:
    """Return what is wrong with the first invalid column of rays, or None if all rays are valid."""
    boxes = box_rules(rays.box, rays.score, np.ones(len(rays), dtype=bool))
    angles = [np.isnan(angle) | ((angle >= 0) & (angle <= np.pi)) for angle in (rays.residual, rays.residual_before)]
    rates = np.column_stack([rays.speed, rays.turn_rate, rays.image])
    rules = (
        (valid_stamps(rays.stamp) & valid_stamps(rays.frame_stamp), "a wrong stamp"),
        (valid_positions(rays.origin), "a wrong origin"),
        (np.abs(lengths(rays.direction) - 1) < _UNIT, "a direction whose length is not 1"),
        (angles[0] & angles[1], "a residual that is not an angle"),
        ((rays.weight >= 0) & (rays.weight <= 1), "a weight outside 0 to 1"),
        (valid_depths(rays.sigma), "a sigma that is not above zero"),
        ((np.abs(rates) < MAX_POSITION).all(axis=1), "a speed, turn rate or place in the image that is not valid"),
        *boxes,
    )
    return next((fault for fine, fault in rules if not fine.all()), None)


@dataclass(frozen=True, eq=False)
class RayFeatures:
    """The appearance vectors of rays.

    ray: (V,) row of each ray in rays.parquet, increasing. vectors: (V, D) unit appearance vector of each ray.
    """

    ray: Ints
    vectors: Floats32


def dump_features(features: RayFeatures) -> bytes:
    """Return the content of features.parquet. Each vector is one row."""
    import pyarrow.parquet as pq

    buffer = io.BytesIO()
    pq.write_table(arrow_table({"ray": features.ray, "features": features.vectors}), buffer)
    return buffer.getvalue()


def read_features(file: Path) -> RayFeatures:
    """Read a features.parquet. Raises OutputError for any other content."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    try:
        table = pq.read_table(file, columns=["ray", "features"], partitioning=None)
        if not pa.types.is_integer(table.schema.field("ray").type) or table["ray"].null_count:
            raise ValueError("the rays are not whole numbers")
        ray, column = np.asarray(table["ray"].to_numpy(), dtype=np.int64), table["features"].combine_chunks()
        flat = np.asarray(column.flatten().to_numpy(zero_copy_only=False))
        vectors = flat.reshape(len(ray), column.type.list_size)
        if flat.dtype != np.float32 or not (np.isfinite(flat).all() and are_unit_vectors(vectors)):
            raise ValueError("a vector does not have the length 1")
        if (np.diff(ray, prepend=-1) <= 0).any():
            raise ValueError("the rays do not increase")
    except (OSError, pa.ArrowException, AttributeError, KeyError, ValueError, TypeError) as error:
        raise OutputError(f"not what a run writes: {str(error).splitlines()[0][:100]}", where=str(file)) from error
    return RayFeatures(ray, vectors)
