"""The settings of the calibration: which errors that all measurements share are estimated, and how large these errors may
be."""

from typing import Literal

from objslam.config.section import NotNegative, Positive, Section


class CalibrationSettings(Section):
    """Configure the errors that all measurements of a robot share. Each number except max_clock is the prior standard
    deviation of the error that its text describes. With 0, the error is not estimated. It is then 0, or it has its value in
    `file`."""

    use: Literal["auto"] | bool = "auto"
    """Which errors are estimated. auto: in joint mode, all errors. In fixed mode, the errors of the cameras, if the log has
    a localisation and `localization.xy` is less than 0.3 m. If base_T_camera of a camera is the identity, the poses are
    those of the camera. auto then does not estimate the rotation, place and lens of this camera. true: estimate these errors
    too, and in fixed mode also with a less accurate localisation. false: estimate none."""
    file: str | None = None
    """File of `objslam calibrate`, or the summary.json of a run. Its values and covariance are the prior of its errors. If
    an error of the file is not estimated, it keeps its value from the file."""
    scale: NotNegative = 0.03
    """Scale error of the odometry, as a share of each distance. The odometry says too long or too short distances."""
    lateral_scale: NotNegative = 0.1
    """Scale error of the sideways distances of the odometry, as a share. It acts in addition to `scale`. Mecanum and omni
    wheels slip as they go sideways. It is estimated only if the robot drives sideways."""
    turn_scale: NotNegative = 0.05
    """Scale error of the turns of the odometry, as a share of each turn."""
    turn_bias: NotNegative = 0.003
    """Turn rate in rad/s that the odometry adds at all times, as a gyroscope without calibration does."""
    turn_per_m: Literal["auto"] | NotNegative = "auto"
    """Turn in rad/m that the odometry adds for each metre ahead. It is 0.01 if the wheels are 0.3 m apart and one wheel is
    0.3 % larger than the other. auto: 0, unless the map shows a gross error."""
    turn_slip: NotNegative = 0.02
    """Distance in m by which the odometry is too long for each rad of turning. A robot with tracks or with four driven
    wheels slips in curves. An odometry that uses the speed of the outer wheel is too long by half the track width for each
    rad. In a curve with a radius of 1 m, 0.02 is 2 % of the distance."""
    clock: NotNegative = 0.1
    """Offset in s of the clock of each camera from the clock of the poses."""
    max_clock: Positive = 0.5
    """Largest clock offset in s that is considered."""
    odometry_clock: bool = True
    """Correct the stamps of the odometry if they are clearly early or late against the stamps of the localisation. They are
    never corrected if `use` is false."""
    yaw: NotNegative = 0.03
    """Rotation error in rad of each camera on the base about the vertical axis."""
    tilt: NotNegative = 0.02
    """Rotation error in rad of each camera on the base about the sideways axis."""
    roll: NotNegative = 0.02
    """Rotation error in rad of each camera on the base about the forward axis."""
    translation: Literal["auto"] | NotNegative = "auto"
    """Position error in m of each camera on the base, along each axis. auto: 0.05 in fixed mode, and in joint mode with a
    localisation alone. 0.02 in joint mode with a localisation and odometry, but 0.05 for the height if the robot moves in a
    plane. 0 in joint mode with odometry alone, unless the map shows a gross error."""
    range_scale: NotNegative = 0.02
    """Scale error of all ranges, as a share of the range. Data sheets of depth cameras promise 2 % of the distance. Six
    recorded runs with two kinds of sensors have errors of 1.2 to 2.3 %."""
    range_offset: NotNegative = 0.05
    """Length in m by which all ranges are too short, along the optical axis. It has two causes: the zero point of a depth
    sensor, and the place of its camera, which was measured with a ruler. It is estimated in joint mode only."""
    surface: NotNegative = 0.3
    """Error of depth.centre that all things of a log share, as a share of half their width. A positive error means that the
    centres are farther behind the visible surfaces. It is estimated in joint mode only."""
    tag_scale: NotNegative = 0.01
    """Error of the given sizes of all fiducials, as a share of the size. The printer, the ruler, the lens and the detector
    of the corners contribute to it. It is estimated in joint mode only."""
    focal: Literal["auto"] | NotNegative = "auto"
    """Error of the focal length of each camera, as a share of this length. auto: 0.02 in fixed mode, and in joint mode with
    a localisation. In joint mode with odometry alone, auto estimates it only if the map shows a gross error. Otherwise, the
    covariances contain an error of 0.02. With 0, the focal length is exact."""
    centre: NotNegative = 0.02
    """Error of the image centre of each camera along each axis, as a share of the focal length. The default is usual for a
    camera whose centre is assumed in the middle of the image. The error of a calibrated centre is smaller."""

    @property
    def corrects_odometry_clock(self) -> bool:
        """Whether the stamps of the odometry may be corrected."""
        return self.odometry_clock and self.use is not False
