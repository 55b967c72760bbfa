"""The settings of the noise of measurements. A run can estimate this noise from the residuals of a log."""

from typing import Literal

from objslam.config.section import Positive, Section

Estimated = Literal["auto"] | bool


class Noise(Section):
    """Configure which noise is estimated from the log. If a noise is estimated, its settings, such as rays.pixel_sigma, are
    only a prior with the weight `prior`.

    auto: estimate a noise if its settings have their default values. The noise of rays, ranges and odometry is estimated
    only in joint mode with odometry. There is one exception in fixed mode. The noise of rays and ranges is estimated there
    if few boxes show each thing, and if these boxes agree only with far more noise. true: estimate a noise even if its
    settings differ from their default values. false: never estimate it.
    """

    rays: Estimated = "auto"
    """Estimate the noise of rays. rays.pixel_sigma and rays.box_sigma have one common factor."""
    ranges: Estimated = "auto"
    """Estimate the noise of ranges. depth.sigma and depth.sigma_per_m have one common factor, and depth.bias has a factor of
    its own. auto estimates neither factor if a camera has its own depth_noise."""
    odometry: Estimated = "auto"
    """Estimate the noise of the odometry, with one factor along the path, one across the path, and one for turns."""
    localization: Estimated = "auto"
    """Estimate the noise of localised poses, with one factor for localization.yaw and one for localization.xy, each at least
    1. In fixed mode, frames that show several objects give the estimate. In joint mode, odometry and rays give the estimate.
    Joint mode also estimates how long errors last, even if localization.* is set. false: in joint mode, the errors of
    different poses are independent."""
    ground: Estimated = "auto"
    """Estimate how far the robot rolls, pitches and rises on uneven ground, if the poses are planar. The estimate replaces
    planar.tilt, planar.z and planar.seconds. It never makes planar.tilt or planar.z smaller. auto: estimate them if planar.*
    has its default values."""
    prior: Positive = 10.0
    """Weight of the noise in the settings against the noise in the log, as a number of residuals. With a larger weight,
    short logs change the noise less."""
