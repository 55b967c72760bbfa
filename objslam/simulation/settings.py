"""What a simulated drive is: the room, the robot, its cameras, the objects and every error; named drives."""

from __future__ import annotations

from math import gcd
from typing import Annotated, Any, Literal, Self

import numpy as np
from pydantic import Field, InstanceOf, model_validator

from objslam import config
from objslam.config import NotNegative, Positive, Section
from objslam.core.camera import Camera, DistortionModel
from objslam.core.geometry import make_pose
from objslam.errors import ConfigError

Probability = Annotated[float, Field(ge=0, le=1)]


def make_camera(
    name: str = "front",
    *,
    width: int = 640,
    height: int = 480,
    focal: float = 460.0,
    position: tuple[float, float, float] = (0.1, 0.0, 0.3),
    yaw: float = 0.0,
    pitch: float = 0.0,
    distortion_model: DistortionModel = "plumb_bob",
    distortion: tuple[float, ...] = (0.0, 0.0, 0.0, 0.0, 0.0),
) -> Camera:
    """A camera at `position` (m, in base) that looks along base x, turned left by `yaw` and up by `pitch` (rad).

    width, height, focal in px; the principal point is the middle of the image.
    """
    cy, sy, cp, sp = np.cos(yaw), np.sin(yaw), np.cos(pitch), np.sin(pitch)
    right, forward = np.array([sy, -cy, 0.0]), np.array([cy * cp, sy * cp, sp])
    rotation = np.column_stack([right, np.cross(forward, right), forward])
    matrix = np.array([[focal, 0.0, (width - 1) / 2], [0.0, focal, (height - 1) / 2], [0.0, 0.0, 1.0]])
    base_T_camera = make_pose(rotation, np.array(position))
    return Camera(name, width, height, matrix, distortion_model, np.array(distortion), base_T_camera)


class PoseNoise(Section):
    """Standard deviations of a planar pose, or of a step between two: per axis in m, and in rad."""

    xy: NotNegative = 0.0
    yaw: NotNegative = 0.0


class DepthNoise(Section):
    """How the depth at a box errs: z along the optical axis."""

    sigma: NotNegative = 0.03
    """m; the part that does not depend on the distance."""
    sigma_per_m: NotNegative = 0.02
    """m per m; the part that grows with it."""
    missing: Probability = 0.0
    """share of the boxes without a depth (NaN)."""
    wrong: Probability = 0.0
    """share of the depths that belong to something else: anywhere up to max_range."""


class DriveSettings(Section):
    """A drive and its errors. The defaults are a drive without any error."""

    name: str = "simulated drive"
    room: tuple[Positive, Positive] = (8.0, 6.0)
    """m along x and y; the map's origin is the middle of the floor."""
    path: tuple[Annotated[int, Field(ge=1)], Annotated[int, Field(ge=1)]] = (2, 3)
    """swings along x and y in a lap (a Lissajous curve, no common divisor): (1, 1) is an ellipse, (1, 2) an eight."""
    margin: Positive = 1.0
    """m between the path and the walls."""
    frames: Annotated[int, Field(ge=2)] = 300
    """frames of each camera; several cameras take turns."""
    frame_rate: Positive = 5.0
    """Hz."""
    speed: Positive = 0.6
    """m/s on average; slower where the path bends."""
    laps: Positive | None = None
    """laps in the whole drive: then the speed follows from it."""

    cameras: tuple[InstanceOf[Camera], ...] = (make_camera(),)
    max_range: Positive = 6.0
    """m; objects further from the camera are not seen."""
    cut_off: bool = False
    """boxes that reach over the image's edge are cut off there, as a detector's are; else such an object is not seen."""

    objects: Annotated[int, Field(ge=0)] = 15
    """objects at random places."""
    classes: Annotated[int, Field(ge=1)] | None = None
    """among this many classes, in turn; None: each object is the only one of its class."""
    placed: tuple[tuple[str, tuple[float, float, float]], ...] = ()
    """further objects at given places in the map: label and x, y, z (m), with the first ids."""
    heights: tuple[float, float] = (0.1, 1.5)
    """m; between these stand the objects' centres."""
    min_distance: NotNegative = 0.6
    """m between any two random objects."""
    min_view_share: Probability = 0.1
    """random objects stand where at least this share of one camera's number of frames could see them,"""
    min_parallax_deg: NotNegative = 30.0
    """and under at least this parallax."""
    moving: Annotated[int, Field(ge=0)] = 0
    """objects that roam the room, of the classes that are there; no part of the truth."""

    pixel_sigma: NotNegative = 0.0
    """px; one standard deviation of a box centre, per axis."""
    missed: Probability = 0.0
    """share of the visible objects without a box."""
    false: Probability = 0.0
    """probability of a box of nothing, in each frame for each class."""
    depth: DepthNoise | None = None
    """boxes carry a depth."""
    tracks: Literal["none", "broken", "perfect"] = "none"
    """track ids of the boxes: `perfect` ones are the objects' ids in the truth (moving objects come after them), `broken`
    ones start again after a second out of sight; boxes of nothing have none."""

    odometry: config.Odometry | PoseNoise | None = PoseNoise()
    """its drift: a random walk with the way (floors are for estimators: unused), or so much a frame; None: no odometry."""
    odometry_rate: Positive | None = 30.0
    """Hz; None: at the stamps of the frames."""
    localization: PoseNoise | None = PoseNoise()
    """the error of each pose; None: no localisation."""
    localization_rate: Positive | None = 10.0
    """Hz; None: at the stamps of the frames."""

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        if self.odometry is None and self.localization is None:
            raise ValueError("a drive needs odometry or localization")
        if gcd(*self.path) != 1:
            raise ValueError("the swings of the path must have no common divisor")
        if 2 * self.margin >= min(self.room):
            raise ValueError("the margin leaves no room for the path")
        if self.moving and not self.objects and not self.placed:
            raise ValueError("moving objects take their class from standing ones, and there are none")
        if not self.cameras or len({camera.name for camera in self.cameras}) < len(self.cameras):
            raise ValueError("a drive needs cameras with a name of their own each")
        return self


_THREE_CLASSES: dict[str, Any] = {"objects": 15, "classes": 3, "pixel_sigma": 3.0, "missed": 0.2, "false": 0.2}
_STEP = PoseNoise(xy=0.01, yaw=float(np.deg2rad(0.3)))
_INDOOR: dict[str, Any] = {"odometry": config.Odometry(), "localization": PoseNoise(xy=0.02, yaw=0.005)}

PRESETS: dict[str, dict[str, Any]] = {
    "demo": {**_INDOOR, "objects": 12, "classes": 4, "frames": 400, "min_view_share": 0.12,
             "pixel_sigma": 2.0, "missed": 0.1, "false": 0.05},
    "rooms": _THREE_CLASSES,
    "hard": {"objects": 24, "classes": 3, "pixel_sigma": 5.0, "missed": 0.4, "false": 0.5, "moving": 2},
    "drift": {**_THREE_CLASSES, "odometry": _STEP, "localization": None, "laps": 2.0},
    "long": {**_INDOOR, "room": (12.0, 9.0), "objects": 46, "classes": 8, "frames": 3000, "frame_rate": 3000 / 900,
             "min_view_share": 0.03, "pixel_sigma": 2.0},
    "large": {**_INDOOR, "room": (30.0, 20.0), "path": (4, 5), "objects": 200, "classes": 10, "frames": 10_000,
              "laps": 4.0, "min_view_share": 0.005, "pixel_sigma": 2.0},
}  # fmt: skip
"""Named drives, as changes to the defaults."""


def preset(name: str, **changes: Any) -> DriveSettings:
    """The settings of a named drive, with changes to single fields. ConfigError: unknown name; ValueError: a field."""
    if name not in PRESETS:
        raise ConfigError(f"there is no simulated drive {name!r}", hint=f"there are {', '.join(PRESETS)}")
    return DriveSettings(**{"name": name, **PRESETS[name], **changes})


def pair(distance: float, label: str = "cup", **changes: Any) -> DriveSettings:
    """A drive around two objects of one class `distance` (m) apart, seen from 1 to 4 m by a camera that looks left."""
    camera = make_camera("left", focal=380.0, position=(0.0, 0.0, 0.3), yaw=np.pi / 2)
    places = ((label, (1.5, -distance / 2, 0.4)), (label, (1.5, distance / 2, 0.4)))
    drive = {"name": "pair", "room": (7.0, 7.0), "path": (1, 1), "laps": 1.0, "objects": 0, "placed": places}
    return DriveSettings(**{**drive, "cameras": (camera,), **changes})
