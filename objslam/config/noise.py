"""The settings of the noise that is estimated from the residuals of a log."""

from typing import Literal

from objslam.config.section import Positive, Section

Estimated = Literal["auto"] | bool


class Noise(Section):
    """Estimate the noise of measurements from the log. The noise in the other settings is then only where the search begins.

    auto: estimated in joint mode if the log has odometry, unless the settings of this noise differ from their defaults. true
    estimates it also then, and false never.
    """

    rays: Estimated = "auto"
    """rays.pixel_sigma and rays.box_sigma, with one common factor."""
    ranges: Estimated = "auto"
    """depth.sigma and depth.sigma_per_m, with one common factor, and depth.bias, with another one."""
    odometry: Estimated = "auto"
    """the noise of the odometry along, across and in turning, with a factor for each."""
    prior: Positive = 10.0
    """the number of residuals that the noise in the settings counts for. A larger number changes it less on short logs."""
