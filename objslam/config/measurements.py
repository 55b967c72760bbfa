"""The settings of the measurements: poses, bearings, depths, odometry, localisation."""

from typing import Annotated, Literal

from pydantic import Field

from objslam.config.section import Finite, NotNegative, Positive, Section


class Poses(Section):
    """Configure which poses of a log are used."""

    use: Literal["auto", "odometry", "localization"] = "auto"
    """Poses to use if a log has odometry and localisation. auto uses the localisation. In joint mode, auto also uses the
    odometry between the localised poses."""
    max_gap: Positive = 1.1
    """Maximum gap of the path in s. A frame in a longer gap is dropped and counted."""


class RayNoise(Section):
    """Configure how boxes become rays."""

    pixel_sigma: Positive = 3.0
    """Standard deviation of a box centre per axis in px."""
    box_sigma: NotNegative = 0.05
    """Standard deviation of a box centre as a share of the box size, which is the geometric mean of width and height. It is
    added in quadrature to pixel_sigma."""
    min_score: NotNegative = 0.0
    """Lowest score of a box that is used. A box with a lower score is dropped and counted."""
    border: Finite = 1.0
    """Distance in px from the image edge within which a box counts as cut off. Its centre is not the centre of the object,
    so the box is dropped and counted. A negative value keeps such boxes."""
    border_share: NotNegative = 0.07
    """Distance from the image edge as a share of the box width or height within which a box also counts as cut off.
    Detectors often end a cut box short of the edge."""


class Depth(Section):
    """Configure the depth at a box. The depth is optional and is used as a range along the ray of the box."""

    use: bool = True
    sigma: Positive = 0.03
    """Constant part of the range noise in m."""
    sigma_per_m: NotNegative = 0.02
    """Part of the range noise that grows with the distance, in m per m."""
    bias: NotNegative = 0.05
    """Standard deviation in m of the error shared by all ranges of one object. Ranges end on the surface of the object, or
    have a calibration error. Averaging does not reduce this error."""


class Odometry(Section):
    """Configure the drift of odometry. It is a random walk: the standard deviations grow with the square root of the
    motion."""

    x_per_m: NotNegative = 0.02
    """Standard deviation along the driving direction in m after 1 m of driving."""
    y_per_m: NotNegative = 0.005
    """Sideways standard deviation in m after 1 m of driving. Wheels slip little sideways. An omnidirectional base may need
    the value of x_per_m."""
    xy_per_rad: NotNegative = 0.005
    """Standard deviation of the position in m after 1 rad of turning in place."""
    yaw_per_m: NotNegative = 0.02
    """Standard deviation of the heading in rad after 1 m of driving."""
    yaw_per_rad: NotNegative = 0.05
    """Standard deviation of the heading in rad after 1 rad of turning."""
    floor_xy: Positive = 1e-3
    """Minimum standard deviation of the position in m per keyframe step. It applies to a robot at rest too."""
    floor_yaw: Positive = 1e-3
    """Minimum standard deviation of the heading in rad per keyframe step. It applies to a robot at rest too."""


class Planar(Section):
    """Configure the deviation of each step from a planar path, because a real floor is not perfectly flat."""

    z: Positive = 1e-3
    """Standard deviation of the height in m."""
    tilt: Positive = 1e-3
    """Standard deviation of roll and of pitch in rad."""


class Localization(Section):
    """Configure the accuracy of absolute poses."""

    xy: Positive = 0.02
    """Standard deviation of x and of y in m."""
    yaw: Positive = 0.005
    """Standard deviation of the heading in rad."""
