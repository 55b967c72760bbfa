"""objslam: object SLAM for mobile robots, from detector boxes and planar poses to a map of objects in 3D."""

from typing import TYPE_CHECKING

__version__ = "0.1.0"

if TYPE_CHECKING:
    from objslam.results.object_map import ObjectMap

__all__ = ["ObjectMap", "__version__"]


def __getattr__(name: str) -> object:
    """`from objslam import ObjectMap`, imported when asked for: the command line must answer at once."""
    if name == "ObjectMap":
        from objslam.results.object_map import ObjectMap

        return ObjectMap
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
