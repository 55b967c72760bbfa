"""The settings of the calibration: which shared errors are estimated, and how large they may be."""

from typing import Literal

from objslam.config.section import NotNegative, Positive, Section


class CalibrationSettings(Section):
    """Errors that all measurements of a robot share. Each number except max_clock is the prior standard deviation of an
    error. With 0, the error is not estimated: it is 0, or the value in `file`."""

    use: Literal["auto"] | bool = "auto"
    """auto: in joint mode, estimate all errors. In fixed mode, estimate the errors of cameras if the log has a localisation
    that is not coarse. If base_T_camera is the identity, the poses are of the camera, so its rotation and place are not
    estimated. true: estimate them too, and in fixed mode also from coarse poses. false: never estimate."""
    file: str | None = None
    """a file of `objslam calibrate`, or the summary.json of a run. Its values and covariance are the prior of its errors. An
    error of the file that is not estimated keeps its value from the file."""
    scale: NotNegative = 0.03
    """share by which all distances of the odometry are too long or too short."""
    lateral_scale: NotNegative = 0.1
    """share by which the sideways distances of the odometry are too long or too short, beside `scale`. Mecanum and omni
    wheels slip as they go sideways. It is estimated only if the robot drives sideways."""
    turn_scale: NotNegative = 0.05
    """share by which all turns of the odometry are too large or too small."""
    turn_bias: NotNegative = 0.003
    """rad/s; the turn rate that the odometry adds at all times, as a gyroscope without calibration does."""
    turn_per_m: Literal["auto"] | NotNegative = "auto"
    """rad/m; the turn that the odometry adds for each metre ahead. If the wheels are 0.3 m apart, and one is 0.3 % larger
    than the other, it is 0.01. auto: 0, unless the map shows a gross error."""
    turn_slip: NotNegative = 0.02
    """m per rad; the distance by which the odometry is too long for each radian of turning. A robot with tracks or four
    driven wheels slips in curves, and an odometry that takes the speed of the outer wheel is too long by half the track. In
    a sharp curve of 1 m radius, 0.02 is 2 % of the distance."""
    clock: NotNegative = 0.1
    """s; the offset of each camera's clock against the clock of the poses."""
    max_clock: Positive = 0.5
    """s; the largest clock offset that is considered."""
    odometry_clock: bool = True
    """whether the stamps of the odometry are corrected if they are clearly early or late against those of the localisation.
    If `use` is false, they are not."""
    yaw: NotNegative = 0.03
    """rad; the rotation of each camera on the base about the vertical axis."""
    tilt: NotNegative = 0.02
    """rad; the rotation of each camera on the base about the sideways axis."""
    roll: NotNegative = 0.02
    """rad; the rotation of each camera on the base about the forward axis."""
    translation: Literal["auto"] | NotNegative = "auto"
    """m; the offset of each camera's place on the base, along each axis. auto: 0.05 in fixed mode and with a localisation,
    0.02 in joint mode with odometry beside it, and 0 in joint mode with odometry alone, unless its map shows a gross
    error."""
    range_scale: NotNegative = 0.02
    """share by which all ranges are too long or too short. Data sheets of depth cameras promise 2 % of the distance, and six
    recorded runs of two kinds of sensors err by 1.2 to 2.3 %."""
    range_offset: NotNegative = 0.05
    """m by which all ranges are too short, along the optical axis. The zero of a depth sensor and the place of its camera,
    which was measured with a ruler, both err. It is estimated in joint mode only."""
    surface: NotNegative = 0.3
    """error of depth.centre that all things of a log share, as a share of half their width. It is positive if the centres
    are farther behind the visible surfaces. It is estimated in joint mode only."""
    tag_scale: NotNegative = 0.01
    """share by which all fiducials of a given size are smaller or larger than the settings say. A printer, a ruler, the lens
    and the detector of the corners each add to it. It is estimated in joint mode only."""
    focal: Literal["auto"] | NotNegative = "auto"
    """share by which the focal length of each camera is too long or too short. auto: 0.02 in fixed mode and with a
    localisation. In joint mode with odometry alone, it is estimated only if the map shows a gross error. Otherwise the
    covariances contain 0.02. 0: it is exact."""
    centre: NotNegative = 0.02
    """share of the focal length by which the image centre of each camera is off, along each axis. The
    default is usual for a centre that is assumed in the middle of the image. A calibrated centre errs by less."""

    @property
    def corrects_odometry_clock(self) -> bool:
        """Whether the stamps of the odometry may be corrected."""
        return self.odometry_clock and self.use is not False
