"""Factors for a localisation, which measures the absolute pose of a keyframe."""

import gtsam
import numpy as np

from objslam.config import Settings
from objslam.core.arrays import Floats
from objslam.core.geometry import adjoint, inverse, is_planar
from objslam.core.types import Keyframes
from objslam.graph.factors.noise import huber
from objslam.graph.variables import X0


def localizations(
    keyframes: Keyframes, settings: Settings, first: int = 0, on_plane: bool | None = None
) -> list[gtsam.NonlinearFactor]:
    """Return priors on the poses of the keyframes, which are X(first), X(first + 1) and so on.

    The priors have Huber's loss, because a localisation may jump. Keyframes that share one measurement share its information
    in equal parts. on_plane: whether the path is planar. If it is None, the poses decide.
    """
    covariance = localization_covariance(keyframes, settings, on_plane)
    return [
        gtsam.PriorFactorPose3(X0 + first + k, gtsam.Pose3(pose), huber(gtsam.noiseModel.Gaussian.Covariance(c)))
        for k, (pose, c) in enumerate(zip(keyframes.map_T_camera, covariance, strict=True))
    ]


def localization_covariance(keyframes: Keyframes, settings: Settings, on_plane: bool | None = None) -> Floats:
    """Return the covariances (K, 6, 6) of the keyframes' absolute poses, in their camera frames, rotation first.

    on_plane: as in `localizations`.
    """
    of, planar = settings.localization, settings.planar
    on_plane = is_planar(keyframes.map_T_base) if on_plane is None else on_plane
    tilt, z = (planar.tilt, planar.z) if on_plane else (of.yaw, of.xy)
    s = np.diag([tilt, tilt, of.yaw, of.xy, of.xy, z]) ** 2 * keyframes.localized_every
    to_camera = adjoint(inverse(keyframes.base_T_camera))
    covariance = to_camera @ s @ np.swapaxes(to_camera, 1, 2)
    return np.asarray((covariance + np.swapaxes(covariance, 1, 2)) / 2)
