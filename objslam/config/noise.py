"""The settings of the noise that is estimated from the residuals of a log."""

from typing import Literal

from objslam.config.section import Positive, Section

Estimated = Literal["auto"] | bool


class Noise(Section):
    """Estimate the noise of measurements from the log. The settings of an estimated noise, such as rays.pixel_sigma, are
    then only a prior of the weight `prior`.

    auto: estimate the noise if the settings of this noise have their defaults. The noise of rays, ranges and odometry is
    estimated only in joint mode with odometry. In fixed mode, the noise of rays and ranges is estimated if few boxes show
    each thing, and they agree only with far more noise. true: estimate it even if these settings differ from their defaults.
    false: never estimate it.
    """

    rays: Estimated = "auto"
    """the noise of rays. rays.pixel_sigma and rays.box_sigma have one common factor."""
    ranges: Estimated = "auto"
    """the noise of ranges. depth.sigma and depth.sigma_per_m have one common factor, and depth.bias has a factor of its own.
    auto estimates none of them if a camera has its own depth_noise."""
    odometry: Estimated = "auto"
    """the noise of the odometry along the path, across it and in turning, with a factor for each."""
    localization: Estimated = "auto"
    """the noise of localised poses, with a factor for localization.yaw and one for localization.xy, each at least 1. In
    fixed mode, it is estimated from frames that show several objects. In joint mode, it is estimated from odometry and rays,
    and how long errors last is estimated too, even if localization.* is set. false: in joint mode, the error of each pose is
    new."""
    ground: Estimated = "auto"
    """how far the robot rolls, pitches and rises on uneven ground, if the poses are planar: planar.tilt, planar.z and
    planar.seconds. The first two are at least as in the settings. auto estimates them if planar.* has its defaults."""
    prior: Positive = 10.0
    """the weight of the noise in the settings, as a number of residuals. With a larger weight, short logs change the noise
    less."""
