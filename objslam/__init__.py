"""objslam: object SLAM for mobile robots, which builds a 3D map of objects from detector boxes and robot poses.

`read` and `run` map a recording, `Log.from_arrays` makes a log from arrays, and `Session` maps while data come.
"""

import importlib
from typing import TYPE_CHECKING

__version__ = "0.1.0"

if TYPE_CHECKING:
    from objslam.api.camera import Camera
    from objslam.api.inputs import Detections, Log, Trajectory
    from objslam.api.mapping import read, run
    from objslam.api.result import Result
    from objslam.api.session import Session
    from objslam.api.sites import diff, merge, register
    from objslam.config import Settings
    from objslam.core.object_map import MapObject
    from objslam.errors import ObjslamError
    from objslam.io.results.object_map import ObjectMap

__all__ = [
    "Camera",
    "Detections",
    "Log",
    "MapObject",
    "ObjectMap",
    "ObjslamError",
    "Result",
    "Session",
    "Settings",
    "Trajectory",
    "__version__",
    "diff",
    "merge",
    "read",
    "register",
    "run",
]

_HOMES = {
    **dict.fromkeys(("Detections", "Log", "Trajectory"), "objslam.api.inputs"),
    **dict.fromkeys(("read", "run"), "objslam.api.mapping"),
    **dict.fromkeys(("diff", "merge", "register"), "objslam.api.sites"),
    **{"Result": "objslam.api.result", "Session": "objslam.api.session", "Settings": "objslam.config"},
    **{"Camera": "objslam.api.camera", "MapObject": "objslam.core.object_map"},
    **{"ObjslamError": "objslam.errors", "ObjectMap": "objslam.io.results.object_map"},
}
"""The module of each name that is imported at its first use, so that the command line starts fast."""


def __getattr__(name: str) -> object:
    """Import a public name at its first use."""
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(_HOMES[name]), name)


def __dir__() -> list[str]:
    return sorted(__all__)
