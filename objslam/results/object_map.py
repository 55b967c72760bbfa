"""The map of objects for users of the package, which can be loaded and saved."""

from os import PathLike
from pathlib import Path
from typing import Self

from objslam.core import object_map
from objslam.io.atomic_files import write_file
from objslam.io.objects_json import dump_objects, read_objects


class ObjectMap(object_map.ObjectMap):
    """Hold the objects of one map in the frame `frame`, and load and save them."""

    @classmethod
    def load(cls, path: str | PathLike[str]) -> Self:
        """Load the map of a result folder or of a file written by `save`. OutputError with the place if it is invalid."""
        from objslam.results.read import load_map  # deferred, because it imports scipy

        found = read_objects(Path(path)) if Path(path).is_file() else load_map(Path(path))
        return cls(found.objects, found.frame)

    def save(self, file: str | PathLike[str]) -> None:
        """Write the map as JSON. `load` returns the same map, bit by bit. OutputError if the file cannot be written."""
        write_file(Path(file), dump_objects(self).encode())
