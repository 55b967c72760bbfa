"""Make tables for users. pyarrow tables are always possible. pandas data frames need an installed pandas."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from objslam.errors import ObjslamError

if TYPE_CHECKING:
    import pandas as pd
    import pyarrow as pa


def arrow_table(columns: Mapping[str, Any]) -> pa.Table:
    """Return a pyarrow table of named columns. Each row of a numpy array (R, k) becomes a cell with a list of k numbers."""
    import pyarrow as pa

    def column(values: Any) -> Any:
        if isinstance(values, np.ndarray) and values.ndim == 2:
            return pa.FixedSizeListArray.from_arrays(pa.array(values.ravel()), values.shape[1])
        return values

    return pa.table({name: column(values) for name, values in columns.items()})


def to_pandas(table: pa.Table) -> pd.DataFrame:
    """Return a pyarrow table as a pandas data frame. Raises ObjslamError if pandas is not installed."""
    try:
        import pandas  # noqa: F401
    except ModuleNotFoundError as error:
        raise ObjslamError("pandas is not installed", hint="pip install pandas, or use to_arrow()") from error
    return table.to_pandas()
