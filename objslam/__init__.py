"""objslam: object SLAM for mobile robots, which builds a 3D map of objects from detector boxes and planar poses."""

from typing import TYPE_CHECKING

__version__ = "0.1.0"

if TYPE_CHECKING:
    from objslam.results.object_map import ObjectMap

__all__ = ["ObjectMap", "__version__"]


def __getattr__(name: str) -> object:
    """Import `ObjectMap` at its first use, so that the command line starts fast."""
    if name == "ObjectMap":
        from objslam.results.object_map import ObjectMap

        return ObjectMap
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
