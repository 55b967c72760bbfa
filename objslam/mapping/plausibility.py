"""A check of the shared errors that names wrong input: an error far beyond its prior has a cause."""

from objslam.core.calibration import Calibration, kind
from objslam.core.diagnostics import Ledger

MOST_SIGMAS = 3.0
"""The size of a shared error, in standard deviations of its prior, above which the user is warned. A larger value warns less
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
    """Warn of each shared error that is far larger than its prior says, and name what may be wrong."""
    for name, of in calibration.to_dict()["parameters"].items():
        sigmas = abs(of["value"]) / of["prior_sigma"]
        if sigmas > MOST_SIGMAS:
            cause = _CAUSES.get(kind(name), "is the calibration right?")
            unit = "" if of["unit"] == "share" else f" {of['unit']}"
            ledger.warn(f"the shared error {name} is {of['value']:.3g}{unit}, {sigmas:.1f} times its prior sigma: {cause}")
