"""The result of a run, from which every output is made."""

from dataclasses import dataclass
from typing import Any

from objslam.config import Settings
from objslam.core.arrays import Floats
from objslam.core.calibration import Calibration
from objslam.core.camera import Camera
from objslam.core.object_map import ObjectMap
from objslam.core.trace import Round
from objslam.core.types import Association, Images, Keyframes, Rays, Surface, Trajectory


@dataclass(frozen=True)
class RunResult:
    """The result of a run with K keyframes and R rays.

    keyframes: the keyframes with their poses before the estimation. map_T_base: (K, 4, 4) their poses after the estimation.
    The mode `fixed` does not change them. association: its objects are indices into map.objects. origins, directions: (R, 3)
    the rays in map at the solved poses. residual: (R,) rad, the angle between each ray and its object, NaN without an
    object. weight: (R,) robust weight in [0, 1]. summary: the content of summary.json. path, path_after: the path of the log
    at its full rate, before and after the estimation. trace: the rounds of the estimation. images: the image files of each
    camera. surface: the surroundings, None without depth images. surface_before: the surroundings at the poses before the
    estimation, None unless the settings ask for it. calibration: the shared errors that were estimated, None if none were.
    residual_before: (R,) rad, the residual before the correction of the shared errors, None if none were estimated. views:
    all camera frames on the path, also those without a box, at the solved poses. None if they were not asked for.
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
    calibration: Calibration | None = None
    residual_before: Floats | None = None
    views: Keyframes | None = None
