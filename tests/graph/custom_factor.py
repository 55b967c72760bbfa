"""The oracle: Eq. 1 and the bearing written straight from their formulas as Python factors, slow but plain to see."""

from __future__ import annotations

import gtsam
import numpy as np

from objslam.core.arrays import Floats


def eq1_factor(pose_key: int, point_key: int, direction: Floats, noise: gtsam.noiseModel.Base) -> gtsam.CustomFactor:
    """The vector (o - m) x n of Eq. 1 (3 rows, m), direction: (3,) unit in the camera frame; its norm is the distance."""

    def error(this: gtsam.CustomFactor, values: gtsam.Values, jacobians: list[Floats] | None) -> Floats:
        pose, point = values.atPose3(this.keys()[0]), values.atPoint3(this.keys()[1])
        rotation, origin = pose.rotation().matrix(), pose.translation()
        n, to = rotation @ direction, point - origin
        if jacobians is not None:
            # d(to x n): the point moves `to`; a rotation w of the camera turns n by R (w x d); a shift t moves m by R t
            jacobians[1] = -_skew(n)
            jacobians[0] = np.hstack([-_skew(to) @ rotation @ _skew(direction), _skew(n) @ rotation])
        return np.cross(to, n)

    return gtsam.CustomFactor(noise, [pose_key, point_key], error)


def eq1_fixed_factor(point_key: int, origin: Floats, n: Floats, noise: gtsam.noiseModel.Base) -> gtsam.CustomFactor:
    """The same with a known pose: ray origin (3,) and unit direction (3,) in map."""

    def error(this: gtsam.CustomFactor, values: gtsam.Values, jacobians: list[Floats] | None) -> Floats:
        if jacobians is not None:
            jacobians[0] = -_skew(n)
        return np.cross(values.atPoint3(this.keys()[0]) - origin, n)

    return gtsam.CustomFactor(noise, [point_key], error)


def _skew(v: Floats) -> Floats:
    return np.array([[0, -v[2], v[1]], [v[2], 0, -v[0]], [-v[1], v[0], 0]])
