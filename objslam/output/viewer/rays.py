"""Log rays to a recording. Used rays are blue, rejected rays are red, and unexplained rays are grey."""

from typing import Any

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from objslam.core.result import RunResult
from objslam.output.plot.style import RayKind, ray_ends, ray_kinds, sample
from objslam.output.viewer.times import moments, stamp_column

_Palette = dict[RayKind, tuple[int, int, int]]

RAY_COLOURS: _Palette = {"used": (62, 128, 214), "rejected": (224, 62, 50), "unexplained": (150, 150, 150)}
"""The RGB colour of each kind of ray."""
_FAINT: _Palette = {"used": (186, 212, 243), "rejected": (246, 205, 200), "unexplained": (222, 222, 222)}
"""The RGB colour of each kind of static ray. It is the colour in `RAY_COLOURS` with about two thirds of white."""
_MAX_RAYS = 240  # The largest number of static rays of each kind. Lines are opaque, so more rays would cover the map.


def log_rays(recording: Any, result: RunResult) -> None:
    """Log the rays at each stamp to `map/rays/now`, and a static sample of each kind of ray to `map/rays/KIND`."""
    strips = np.stack([result.origins, ray_ends(result)], axis=1).astype(np.float32)
    for kind, mask in ray_kinds(result).items():
        index = sample(mask, _MAX_RAYS)
        if len(index):
            lines = rr.LineStrips3D(strips[index], colors=[_FAINT[kind]], radii=rr.Radius.ui_points(0.4))
            recording.log(f"map/rays/{kind}", lines, static=True)
    stamps, counts, order = moments(result.keyframes.stamps, result.rays.keyframe)
    columns = rr.LineStrips3D.columns(strips=strips[order], colors=kind_colours(result)[order]).partition(counts)
    recording.send_columns("map/rays/now", [stamp_column(stamps)], columns)
    recording.log("map/rays/now", rr.LineStrips3D.from_fields(radii=rr.Radius.ui_points(1.5)), static=True)


def kind_colours(result: RunResult) -> NDArray[np.uint8]:
    """Return the colour (R, 3), RGB, of each ray by its kind: used, rejected or unexplained."""
    colours = np.zeros((len(result.rays), 3), dtype=np.uint8)
    for kind, mask in ray_kinds(result).items():
        colours[mask] = RAY_COLOURS[kind]
    return colours
