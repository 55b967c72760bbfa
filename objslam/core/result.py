"""What a run has to show, as one value that every output is made from."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from objslam.config import Settings
from objslam.core.arrays import Floats
from objslam.core.camera import Camera
from objslam.core.object_map import ObjectMap
from objslam.core.trace import Round
from objslam.core.types import Association, Images, Keyframes, Rays, Surface, Trajectory


@dataclass(frozen=True)
class RunResult:
    """What a run has to show.

    keyframes: before estimation. map_T_base: (K, 4, 4) after it (the keyframes' own in fixed mode). association: ray ->
    index into map.objects, -1 none. origins, directions: (R, 3) in map at the solved poses. residual: (R,) rad, the angle of
    the object off its ray, NaN without object. weight: (R,) robust weight in [0, 1]. summary: what summary.json gets.
    path: the full path that the log brought, at its own rate, before estimation; path_after: the same path after it.
    trace: the rounds of the estimation, and images: those of each camera, for the recording. surface: the room, where the
    log has depth images; surface_before: the same at the poses as the log brought them, where the settings ask for it.
    """

    map: ObjectMap
    keyframes: Keyframes
    map_T_base: Floats
    rays: Rays
    association: Association
    origins: Floats
    directions: Floats
    residual: Floats
    weight: Floats
    summary: dict[str, Any]
    settings: Settings
    cameras: tuple[Camera, ...]
    path: Trajectory
    path_after: Trajectory
    trace: tuple[Round, ...] = ()
    images: tuple[Images | None, ...] = ()
    surface: Surface | None = None
    surface_before: Surface | None = None
