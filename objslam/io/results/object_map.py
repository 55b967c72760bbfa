"""The map of objects for users of the package. It can be loaded and saved."""

from __future__ import annotations

from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Self

from objslam.core import object_map
from objslam.io.atomic_files import write_file
from objslam.io.objects_json import dump_objects, read_objects
from objslam.io.tables import arrow_table, to_pandas

if TYPE_CHECKING:
    import pandas as pd
    import pyarrow as pa


class ObjectMap(object_map.ObjectMap):
    """The objects of one map in the coordinate frame `frame`. The map can be loaded and saved."""

    @classmethod
    def load(cls, path: str | PathLike[str]) -> Self:
        """Load the map from a result folder, or from a file that `save` wrote.

        Raises OutputError, which names the missing file or the malformed object.
        """
        from objslam.io.results.read import load_map  # deferred, because it imports scipy

        found = read_objects(Path(path)) if Path(path).is_file() else load_map(Path(path))
        return cls.of(found)

    def save(self, file: str | PathLike[str]) -> None:
        """Write the map as JSON. `load` restores each finite number exactly. Raises OutputError for a disk error."""
        write_file(Path(file), dump_objects(self).encode())

    def to_arrow(self) -> pa.Table:
        """Return a pyarrow table with one row for each object. `core.object_map.COLUMNS` has the names of the columns."""
        import pyarrow as pa

        rows = [o.row() for o in self.objects]
        return arrow_table(
            {name: pa.array([row[name] for row in rows], pa.type_for_alias(t)) for name, t in object_map.COLUMNS.items()}
        )

    def to_pandas(self) -> pd.DataFrame:
        """Return the objects as a pandas data frame. Raises ObjslamError if pandas is not installed."""
        return to_pandas(self.to_arrow())
