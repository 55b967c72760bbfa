"""The map of objects as users hold it: one that is loaded from a result and saved to a file."""

from __future__ import annotations

from os import PathLike
from pathlib import Path
from typing import Self

from objslam.core import object_map
from objslam.io.atomic_files import write_file
from objslam.io.objects_json import dump_objects, read_objects


class ObjectMap(object_map.ObjectMap):
    """The objects of one map, in `frame`, with the way from and to disk."""

    @classmethod
    def load(cls, path: str | PathLike[str]) -> Self:
        """The map of a result folder, or of a file as `save` writes it. OutputError, saying where, if it is not one."""
        from objslam.results.read import load_map  # it brings scipy along: a map in memory is light

        found = read_objects(Path(path)) if Path(path).is_file() else load_map(Path(path))
        return cls(found.objects, found.frame)

    def save(self, file: str | PathLike[str]) -> None:
        """Write the map as JSON (objects.json). `load` gives the same map back, to the last bit.

        OutputError when the file cannot be written.
        """
        write_file(Path(file), dump_objects(self).encode())
