"""A check of the shared errors that names wrong input, because an error far beyond its prior has a cause."""

import numpy as np

from objslam.core.arrays import Floats
from objslam.core.calibration import Calibration, kind
from objslam.core.diagnostics import Ledger
from objslam.mapping.checks.finding import Finding

MOST_SIGMAS = 3.0
"""A shared error of more than this many standard deviations of its prior causes a warning. A larger value warns less
often."""

_CAUSES = {
    "clock": "do the stamps of the camera and of the poses use the same clock?",
    "scale": "is the odometry in metres?",
    "turn_scale": "is the odometry's rotation in radians, and its wheel base right?",
    "turn_bias": "does the odometry turn while the robot stands?",
    "yaw": "is base_T_camera right?",
    "tilt": "is base_T_camera right?",
    "roll": "is base_T_camera right?",
    "range_scale": "is the depth in metres (depth_scale)?",
    "focal": "are the camera matrix and the boxes of the same image size?",
}


def warn_of_large_errors(calibration: Calibration, ledger: Ledger) -> None:
    """Warn of each shared error that is far from the mean of its prior, and name the probable cause.

    The value of an error that the log does not show follows the noise, so it causes no warning.
    The prior is from the settings or from a calibration file. A large error causes no warning if the file already has it.
    """
    for name, of in calibration.to_dict()["parameters"].items():
        expected = of["prior_mean"]
        sigmas = abs(of["value"] - expected) / of["prior_sigma"]
        if sigmas > MOST_SIGMAS and of["observable"]:
            cause = _CAUSES.get(kind(name), "is the calibration right?")
            unit = "" if of["unit"] == "share" else f" {of['unit']}"
            far = f"{sigmas:.1f} times its prior sigma"
            if expected:
                far += f" from the {expected:.3g}{unit} of the calibration file; if it has changed, calibrate again"
            ledger.warn(f"the shared error {name} is {of['value']:.3g}{unit}, {far}: {cause}")


def uncorrected(calibration: Calibration, bounds: Floats) -> list[Finding]:
    """Return a finding for each shared error that ended at its bound (P,). The true error may be larger and is not
    corrected.

    There is no finding for an error within one standard deviation of its prior mean, which a calibration file may set.
    """
    ended = np.abs(calibration.values) >= 0.999 * bounds
    ended &= np.abs(calibration.values - calibration.expected) > calibration.prior
    return [
        Finding(
            f"{name} at its bound",
            f"the shared error {name} ended at its bound of {bound:.3g}, so it is not corrected: "
            + _CAUSES.get(kind(name), "is the calibration right?"),
        )
        for name, bound, at in zip(calibration.names, bounds.tolist(), ended.tolist(), strict=True)
        if at
    ]
