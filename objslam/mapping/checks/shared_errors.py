"""Check the shared errors and the noise. A value far beyond its prior has a cause, which a warning names."""

import numpy as np

from objslam.core.arrays import Floats
from objslam.core.calibration import OBSERVABLE, Calibration, kind
from objslam.core.diagnostics import Ledger
from objslam.core.estimate import Estimate
from objslam.core.noise import MOST_NOISE, MOST_POSE_NOISE, NoiseFactors
from objslam.mapping.checks.finding import Finding

MOST_SIGMAS = 3.0
"""The most prior standard deviations by which a shared error may differ from its prior mean without a warning. A larger
value warns less often."""
_WIDENED, _PART = 1.5, 0.25
"""The limits of a warning about shared errors of which the log shows only the sum. If the sum is large, the priors of the
errors are widened by factors (`Calibration.prior_factor`). A warning follows if the largest factor exceeds `_WIDENED`. The
factor is 1.5 for a sum that is 2.3 standard deviations from its prior. The warning names an error if its variance grew by at
least the share `_PART` of the largest growth. Larger values warn less often, and name fewer errors."""

_CAUSES = {
    "clock": "do the stamps of the camera and of the poses use the same clock?",
    "scale": "is the odometry in metres?",
    "lateral_scale": "do the wheels slip as the robot drives sideways?",
    "turn_scale": "does the robot skid as it turns (tracks, four driven wheels), and is its wheel base right?",
    "turn_slip": "does the robot slip in curves, or does its odometry say what was commanded?",
    "turn_bias": "does the odometry turn while the robot stands?",
    "turn_per_m": "is one wheel larger than the other?",
    "yaw": "is base_T_camera right?",
    "tilt": "is base_T_camera right?",
    "roll": "is base_T_camera right?",
    "range_scale": "is the depth in metres (depth_scale)?",
    "range_offset": "do the depths start at the camera, and is base_T_camera right?",
    "surface": "do the depths end on the surfaces of the things (depth.centre)?",
    "tag_scale": "is tags.size the side between the corners that the detector reports?",
    "focal": "are the camera matrix and the boxes of the same image size?",
    "cx": "are the camera matrix and the boxes of the same image size?",
    "cy": "are the camera matrix and the boxes of the same image size?",
    "x": "is the translation of base_T_camera right?",
    "y": "is the translation of base_T_camera right?",
}


_NOISES = {
    "rays": "of the boxes",
    "ranges": "of the depths",
    "range_bias": "that all depths of an object share",
    "along": "of the odometry along the path",
    "across": "of the odometry across the path",
    "turning": "of the odometry's heading",
    "heading": "of the localisation's heading (localization.yaw)",
    "place": "of the localisation's place (localization.xy)",
}
_NOISIER = 2.5
"""The least noise of a label's depths that is reported, as a multiple of the noise of all labels. With a larger number,
fewer labels are reported. In eight simulated flats, tables reach 1.9 to 4.4, and other things 0.5 to 1.9. Chairs reach 4.5
on one map that took several chairs for one."""
_DEPTHS, _ODOMETRY, _POSES = ("ranges", "range_bias"), ("along", "across", "turning"), ("heading", "place")


def warn_of_large_errors(calibration: Calibration, ledger: Ledger) -> None:
    """Warn of each shared error that is far from the mean of its prior, and name the probable cause.

    If the log does not show an error, its value follows the noise. Such an error causes no warning. The prior is from
    the settings or from a calibration file. A large error causes no warning if the file already has it.
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
    _warn_of_sums(calibration, ledger)


def warn_of_noisy_labels(noise: NoiseFactors, ledger: Ledger) -> None:
    """Warn of each label whose depths are far noisier than those of all labels together.

    The solver already takes these depths with their own noise, so no position is spoilt.
    """
    for one in noise.by_label:
        own, usual = max((one.ranges, noise.ranges), (one.range_bias, noise.range_bias), key=lambda pair: pair[0] / pair[1])
        if own > _NOISIER * max(usual, 1.0):
            ledger.warn(
                f"the depths of the label '{one.label}' are {own:.1f} times as noisy as the settings say, and those of all "
                f"labels {usual:.1f} times: perhaps the camera sees through these things, or nearer things cover them. Such "
                "depths count less, and the sigmas of the objects are larger"
            )


def _warn_of_sums(calibration: Calibration, ledger: Ledger) -> None:
    """Warn of errors whose sum is too large, if the log shows only their sum."""
    if calibration.prior_factor is None:
        return
    left = (calibration.sigma > OBSERVABLE * calibration.prior) & [kind(name) in _CAUSES for name in calibration.names]
    excess = np.where(left, calibration.prior_factor**2 - 1, 0.0)
    some = np.flatnonzero(excess >= _PART * excess.max()).tolist()
    if excess.max() <= _WIDENED**2 - 1 or len(some) < 2:
        return
    names = [calibration.names[i] for i in some]
    said = ", ".join(f"{name} {calibration.values[i]:+.2g}" for i, name in zip(some, names, strict=True))
    causes = ", or: ".join(dict.fromkeys(_CAUSES[kind(name)] for name in names))
    ledger.warn(
        f"some shared errors are larger than usual, and the log does not show which ({said}), so their sigmas grow: {causes}"
    )


def at_bounds(estimate: Estimate, bounds: Floats) -> list[Finding]:
    """Return a finding for each shared error that ended at its bound (P,), and for each noise that ended at its bound."""
    errors = [] if estimate.calibration is None else _uncorrected(estimate.calibration, bounds)
    return errors + ([] if estimate.noise is None else _with_most_noise(estimate.noise))


def _uncorrected(calibration: Calibration, bounds: Floats) -> list[Finding]:
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


def _with_most_noise(noise: NoiseFactors) -> list[Finding]:
    """Return a finding for each noise that ended at its bound. With noise at its bound, wrong input fits too.

    Wheels may slip that far, and a depth image may be that bad, but hardly both in one log. No detector errs by that many
    pixels. So the positions are spoilt if the noise of the boxes ends at its bound. They are also spoilt if the noise of the
    depths and the noise of the odometry both end at their bounds.
    """
    limits = {name: MOST_POSE_NOISE if name in _POSES else MOST_NOISE for name in _NOISES}
    ended = [name for name, limit in limits.items() if getattr(noise, name) >= 0.999 * limit]
    depths, odometry = ([name for name in names if name in ended] for names in (_DEPTHS, _ODOMETRY))
    return [
        Finding(
            f"noise {name} at its bound",
            f"the boxes agree only if the noise {_NOISES[name]} is {limits[name]:.3g} times what the settings say, or more: "
            "unless it really is, the input is wrong",
            spoils=name == "rays" or bool(depths and odometry),
        )
        for name in ended
    ]
