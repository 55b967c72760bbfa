"""The settings of a simulated drive: the room, the robot, the cameras, the objects and every error."""

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
    """Make a camera at `position` (m, in base) that looks along base x, turned left by `yaw` and up by `pitch` (rad).

    width, height and focal are in px. The principal point is the centre of the image.
    """
    cy, sy, cp, sp = np.cos(yaw), np.sin(yaw), np.cos(pitch), np.sin(pitch)
    right, forward = np.array([sy, -cy, 0.0]), np.array([cy * cp, sy * cp, sp])
    rotation = np.column_stack([right, np.cross(forward, right), forward])
    matrix = np.array([[focal, 0.0, (width - 1) / 2], [0.0, focal, (height - 1) / 2], [0.0, 0.0, 1.0]])
    base_T_camera = make_pose(rotation, np.array(position))
    return Camera(name, width, height, matrix, distortion_model, np.array(distortion), base_T_camera)


class PoseNoise(Section):
    """The standard deviations of a planar pose, or of a step between two poses.

    xy: the standard deviation along x, and along y, m. yaw: the standard deviation of the yaw, rad.
    """

    xy: NotNegative = 0.0
    yaw: NotNegative = 0.0


class DepthNoise(Section):
    """The errors of the depths of boxes. A depth is z along the optical axis."""

    sigma: NotNegative = 0.03  # The constant part of the standard deviation, m.
    sigma_per_m: NotNegative = 0.02  # The part of the standard deviation that grows with the depth, m per m.
    missing: Probability = 0.0  # The share of boxes whose depth is missing (NaN).
    wrong: Probability = 0.0  # The share of boxes with a wrong depth, which is random from 0.3 m to max_range.
    surface: NotNegative = 0.5  # The distance from an object's surface to its centre, as a share of the half width.


class AppearanceNoise(Section):
    """The appearance vectors of boxes, and how often they confuse objects.

    The vector of a box is the vector of its object plus noise. A box is confused if its vector is nearer to the vector of
    another object with the same label. The noise is chosen so that the share of confused boxes is `confusion`.
    """

    confusion: Probability = 0.2  # The share of boxes that are confused, among those of labels with two objects or more.
    numbers: Annotated[int, Field(ge=2)] = 64  # The number of components of a vector.
    common: Probability = 0.6  # The share of the squared length of a vector that all objects of a label have in common.


class CourseSettings(Section):
    """The path of the robot, and the errors of its odometry and its localisation."""

    name: str = "simulated drive"
    room: tuple[Positive, Positive] = (8.0, 6.0)
    """The size of the room along x and y, m. The origin of the map is the centre of the floor."""
    path: tuple[Annotated[int, Field(ge=1)], Annotated[int, Field(ge=1)]] = (2, 3)
    """The numbers of swings of the path along x and along y in a lap. The path is a Lissajous curve. The numbers have no
    common divisor. (1, 1) is an ellipse."""
    margin: Positive = 1.0  # The distance between the path and the walls, m.
    frames: Annotated[int, Field(ge=2)] = 300
    """The number of images of each camera."""
    together: bool = False
    """Whether several cameras take their images at the same time. If False, the cameras take turns."""
    frame_rate: Positive = 5.0  # The number of images of each camera per second, Hz.
    laps: Positive | None = None  # The number of laps in the whole drive, which determines the speed.
    odometry: config.Odometry | PoseNoise | None = PoseNoise()
    """The noise of the odometry. config.Odometry: the noise grows with the distance and the angle of a step, and the floors
    of this section are ignored. PoseNoise: the noise of a step between two images. None: there is no odometry."""
    localization: PoseNoise | None = PoseNoise()  # The error of each localised pose. None: no localisation.


class DriveSettings(CourseSettings):
    """The settings of a drive. The default is a drive without errors."""

    speed: Positive = 0.6  # The mean speed, m/s, if `laps` is None. The robot is slower in bends.
    cameras: tuple[InstanceOf[Camera], ...] = (make_camera(),)
    max_range: Positive = 6.0  # The largest distance at which a camera sees an object, m.
    cut_off: bool = False
    """Whether boxes are cut off at the image's edge, like boxes of real detectors. If False, objects at the edge get no
    box."""
    objects: Annotated[int, Field(ge=0)] = 15
    """The number of objects at random positions."""
    classes: Annotated[int, Field(ge=1)] | None = None
    """The number of classes. The objects get the classes in turn. None gives each object its own class."""
    placed: tuple[tuple[str, tuple[float, float, float]], ...] = ()
    """The label and the x, y, z (m, in map) of additional objects. They have the first ids."""
    heights: tuple[float, float] = (0.1, 1.5)  # The range of the heights of the objects' centres, m.
    min_distance: NotNegative = 0.6  # The least distance between two random objects, m.
    min_view_share: Probability = 0.1
    """The least number of images that show a random object, as a share of the number of images of one camera. The images of
    all cameras count."""
    min_parallax_deg: NotNegative = 30.0  # The least parallax over the views of a random object, degrees.
    moving: Annotated[int, Field(ge=0)] = 0
    """The number of moving objects. They have the classes of the other objects and are not in the ground truth."""
    pixel_sigma: NotNegative = 0.0  # The standard deviation of the error of a box centre along each axis, px.
    missed: Probability = 0.0  # The share of visible objects without a box.
    false: Probability = 0.0  # The probability of a false box, in each frame for each class.
    depth: DepthNoise | None = None  # The errors of depths. None: boxes have no depths.
    appearance: AppearanceNoise | None = None  # The appearance vectors of boxes. None: boxes have none.
    tracks: Literal["none", "broken", "perfect"] = "none"
    """The track ids of boxes. With `perfect`, boxes have the ids of their objects in the ground truth, and moving objects
    have the next ids. With `broken`, an object gets a new id after one second without a box. False boxes have no id."""
    odometry_rate: Positive | None = 30.0  # The rate of the odometry, Hz. None: one pose at the stamp of each image.
    localization_rate: Positive | None = 10.0  # The rate of the localisation, Hz. None: one pose at the stamp of each image.

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        if self.odometry is None and self.localization is None:
            raise ValueError("a drive needs odometry or localization")
        if gcd(*self.path) != 1:
            raise ValueError("the swings of the path must have no common divisor")
        if 2 * self.margin >= min(self.room):
            raise ValueError("the margin leaves no room for the path")
        if self.moving and not self.objects and not self.placed:
            raise ValueError("moving objects take their classes from standing objects, so set objects or placed")
        if not self.cameras or len({camera.name for camera in self.cameras}) < len(self.cameras):
            raise ValueError("a drive needs cameras, and each needs a name of its own")
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
"""The named drives, as changes to the defaults of `DriveSettings`."""


def preset(name: str, **changes: Any) -> DriveSettings:
    """Return the settings of a named drive with changes. Raises ConfigError (unknown name) or ValueError (a bad field)."""
    if name not in PRESETS:
        raise ConfigError(f"there is no simulated drive {name!r}", hint=f"choose {', '.join(PRESETS)}")
    return DriveSettings(**{"name": name, **PRESETS[name], **changes})


def pair(distance: float, label: str = "cup", **changes: Any) -> DriveSettings:
    """Return the settings of a drive around two objects of one class. distance: the distance of the objects, m.

    The camera looks to the left, at the objects, from 1 to 4 m away. changes: changes to the settings.
    """
    camera = make_camera("left", focal=380.0, position=(0.0, 0.0, 0.3), yaw=np.pi / 2)
    places = ((label, (1.5, -distance / 2, 0.4)), (label, (1.5, distance / 2, 0.4)))
    drive = {"name": "pair", "room": (7.0, 7.0), "path": (1, 1), "laps": 1.0, "objects": 0, "placed": places}
    return DriveSettings(**{**drive, "cameras": (camera,), **changes})
