"""The planar part of the motions that odometry measures: its noise, and its derivatives by shared errors."""

import numpy as np

from objslam.config import Settings
from objslam.core.arrays import Floats, Ints
from objslam.core.calibration import CalibratedMeasurements, kind
from objslam.core.geometry import adjoint, inverse

_LEFT_OUT = ("turn_per_m",)
"""The errors of the odometry that the filter does not estimate. The solve after the filter estimates them. If the filter
also estimated `turn_per_m`, one of ten simulated drives had four objects twice, and drives with this error were not explored
better."""


def planar_noise(drift: Floats, odom_T_base: Floats, settings: Settings) -> Floats:
    """Return the covariances (P-1, 3, 3) of the motions' yaw (rad), x and y (m) in the base after each motion.

    drift: (P, 6, 6), accumulated in the frame odom. odom_T_base: (P, 4, 4). The noise floor of the settings is added.
    """
    to_base = adjoint(inverse(odom_T_base[1:]))
    noise = (to_base @ np.diff(drift, axis=0) @ np.swapaxes(to_base, 1, 2))[:, 2:5, 2:5]
    of = settings.odometry
    return np.asarray(noise + np.diag([of.floor_yaw, of.floor_xy, of.floor_xy]) ** 2)


def motions_by_shared_errors(errors: CalibratedMeasurements | None, first: Ints, motion: Floats) -> tuple[Floats, Floats]:
    """Return the derivatives (P-1, 3, S) of the motions' yaw, x and y by S shared errors, and the errors' prior sigmas (S,).

    The shared errors are one clock for all cameras, and the errors of the odometry without `_LEFT_OUT`. motion: (P-1, 4, 4)
    of the base, from keyframe to keyframe of `first` (P,).
    """
    groups: dict[str, list[int]] = {}
    for i, name in enumerate(errors.names if errors is not None else ()):
        if kind(name) == "clock" or (name.startswith("odometry.") and kind(name) not in _LEFT_OUT):
            groups.setdefault("clock" if kind(name) == "clock" else name, []).append(i)
    if errors is None or not groups:
        return np.zeros((len(motion), 3, 0)), np.zeros(0)
    change, prior = [], []
    for which in groups.values():
        step = np.zeros(len(errors.mean))
        step[which] = errors.steps[which]
        base = errors.at(errors.mean + step, drift=False)[0].odom_T_base
        assert base is not None
        moved = inverse(motion) @ inverse(base[first[:-1]]) @ base[first[1:]]
        planar = [np.arctan2(moved[:, 1, 0], moved[:, 0, 0]), moved[:, 0, 3], moved[:, 1, 3]]
        change.append(np.stack(planar, axis=1) / errors.steps[which[0]])
        prior.append(np.sqrt(errors.prior[which[0], which[0]]))
    return np.stack(change, axis=2), np.array(prior)
