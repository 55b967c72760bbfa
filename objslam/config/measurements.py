"""The settings of what is measured: poses, bearings, depths, odometry, localisation."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from objslam.config.section import NotNegative, Positive, Section


class Poses(Section):
    """How poses are read off the log."""

    use: Literal["auto", "odometry", "localization"] = "auto"
    """which poses of a log that has both: auto takes the localisation, and in joint mode the odometry between its poses."""
    max_gap: Positive = 1.1
    """s; a frame in a longer gap of the path is dropped and counted."""


class RayNoise(Section):
    """From boxes to rays."""

    pixel_sigma: Positive = 3.0
    """px; one standard deviation of a box centre, per axis."""
    box_sigma: NotNegative = 0.05
    """share of a box's size (geometric mean of width and height) that is added, in squares, to the noise of its centre."""
    min_score: NotNegative = 0.0
    """boxes with a lower score are dropped and counted."""
    border: Annotated[float, Field(allow_inf_nan=False)] = 1.0
    """px; a box that comes this close to the image's edge is cut off there, its centre is not the object's: dropped and
    counted. A negative number keeps such boxes."""
    border_share: NotNegative = 0.07
    """share of a box's own width or height that counts as close to the edge as well: detectors let cut boxes end short of
    it."""


class Depth(Section):
    """The optional depth at a box, used as a range along its ray."""

    use: bool = True
    sigma: Positive = 0.03
    """m; the part of the noise that does not depend on the distance."""
    sigma_per_m: NotNegative = 0.02
    """m per m; the part of the noise that grows with the distance."""
    bias: NotNegative = 0.05
    """m; the error that all ranges of one object share, because they end on its surface or are calibrated a little long.
    More ranges do not average it out."""


class Odometry(Section):
    """How far odometry drifts: standard deviations that grow with the square root of the way (a random walk)."""

    x_per_m: NotNegative = 0.02
    """m along the drive after 1 m of it."""
    y_per_m: NotNegative = 0.005
    """m sideways after 1 m; wheels hardly slip sideways, an omnidirectional base may need as much as for x."""
    xy_per_rad: NotNegative = 0.005
    """m after turning 1 rad on the spot."""
    yaw_per_m: NotNegative = 0.02
    """rad after 1 m of driving."""
    yaw_per_rad: NotNegative = 0.05
    """rad after turning 1 rad."""
    floor_xy: Positive = 1e-3
    """m for each step between keyframes; the noise that remains when the robot stands."""
    floor_yaw: Positive = 1e-3
    """rad for each step between keyframes; likewise."""


class Planar(Section):
    """How planar a planar path is, for each step; a real floor is not perfect."""

    z: Positive = 1e-3
    """m; one standard deviation of the height."""
    tilt: Positive = 1e-3
    """rad; one standard deviation of roll and of pitch."""


class Localization(Section):
    """How good absolute poses are (standard deviation of each pose)."""

    xy: Positive = 0.02
    """m; of x and of y."""
    yaw: Positive = 0.005
    """rad; of the heading."""
