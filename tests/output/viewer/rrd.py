"""A recording read back with rerun's own reader."""

from __future__ import annotations

from collections import defaultdict
from pathlib import Path
from typing import Any

import pyarrow as pa


class Recording:
    """The columns of a recording by entity path and component, those of several chunks one after the other."""

    def __init__(self, file: Path) -> None:
        from rerun.chunk import RrdReader

        self.columns: dict[tuple[str, str], list[Any]] = defaultdict(list)
        self.types: dict[tuple[str, str], pa.DataType] = {}
        self.static: dict[str, set[bool]] = defaultdict(set)
        for chunk in RrdReader(file).stream().to_chunks():
            batch = chunk.to_record_batch()
            self.static[chunk.entity_path].add(chunk.is_static)
            for field, column in zip(batch.schema, batch.columns, strict=True):
                kind = column.type
                at = column.cast(pa.int64()) if pa.types.is_temporal(kind) else column
                self.columns[chunk.entity_path, field.name] += at.to_pylist()
                self.types[chunk.entity_path, field.name] = kind

    def get(self, path: str, component: str) -> list[Any]:
        """The rows of a component that were logged, also if what was logged is empty."""
        assert (path, component) in self.columns, f"no {component} in {path}"
        return [row for row in self.columns[path, component] if row is not None]

    def paths(self) -> set[str]:
        """The entities of the data, without those of the blueprint."""
        roots = ("/map", "/log", "/plots", "/summary", "/field")
        return {path for path, _ in self.columns if path.startswith(roots)}


def rgb(packed: int) -> tuple[int, int, int]:
    """A colour of a recording."""
    return packed >> 24 & 255, packed >> 16 & 255, packed >> 8 & 255
