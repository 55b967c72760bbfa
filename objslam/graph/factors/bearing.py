"""Factors for the bearing of a box: the angle between ray and object, or the distance of the object from the ray (Eq. 1)."""

import gtsam
import numpy as np

from objslam.core.arrays import Floats, Ints
from objslam.core.geometry import make_pose
from objslam.graph.factors.noise import Noise
from objslam.graph.variables import L0, X0

STANDOFF = 1e7
"""The distance (m) of a virtual camera behind the origin of its ray. A larger value leaves less perspective and rounds more
coarsely. The relative error by perspective is the range divided by this distance. Rounding (1e-16 of it) is a nanometre."""
L1_RADIANS = 1e-4
"""The angle (rad) below which the loss `l1` on bearings is quadratic, which gives it a derivative at 0. A larger angle is
smoother and less like a norm. It was chosen far below the noise of a box (a twentieth of a pixel)."""
EQ1_SIGMA = 0.05
"""The standard deviation (m) of the point-to-line distance in the joint solve. A larger value trusts the odometry more.
Eq. 1 has no noise model, so this value weighs its distances against the odometry."""
_ORTHOGRAPHIC = gtsam.Cal3DS2(STANDOFF, STANDOFF, 0, 0, 0, 0, 0, 0, 0)
_CENTRE = np.zeros(2)


def bearings(keyframe: Ints, directions: Floats, landmark: Ints, noise: Noise) -> list[gtsam.NonlinearFactor]:
    """Return a factor per ray on the angle (rad) from its direction (R, 3) to L(landmark), in the frame of X(keyframe)."""
    make, unit = gtsam.BearingFactor3D, gtsam.Unit3
    return [
        make(X0 + k, L0 + j, unit(direction), model)
        for direction, model, k, j in zip(directions, noise, keyframe.tolist(), landmark.tolist(), strict=True)
    ]


def point_to_line(keyframe: Ints, directions: Floats, landmark: Ints, noise: Noise) -> list[gtsam.NonlinearFactor]:
    """Return a factor for each ray on the distance (m, Eq. 1) of L(landmark) from the ray, which starts at X(keyframe).

    The directions (R, 3) are in the camera frame. The pose is a variable.
    """
    make, bodies = gtsam.GenericProjectionFactorCal3DS2, virtual_cameras(np.zeros_like(directions), directions)
    return [
        make(_CENTRE, model, X0 + k, L0 + j, _ORTHOGRAPHIC, False, False, body)
        for body, model, k, j in zip(bodies, noise, keyframe.tolist(), landmark.tolist(), strict=True)
    ]


def point_to_line_fixed(origins: Floats, directions: Floats, landmark: Ints, noise: Noise) -> list[gtsam.NonlinearFactor]:
    """Return a factor for each fixed ray on the distance (m, Eq. 1) of L(landmark) from the ray.

    Origins (R, 3) and directions (R, 3) are in map. The norm of the residual is the distance.
    """
    make, camera = gtsam.TriangulationFactorCal3DS2, gtsam.PinholeCameraCal3DS2
    return [
        make(camera(pose, _ORTHOGRAPHIC), _CENTRE, model, L0 + j)
        for pose, model, j in zip(virtual_cameras(origins, directions), noise, landmark.tolist(), strict=True)
    ]


def virtual_cameras(origins: Floats, directions: Floats) -> list[gtsam.Pose3]:
    """Return a distant camera for each ray. It looks along the ray, which has an origin (R, 3) and a direction (R, 3).

    The camera images a point at the point's offset (m) across the ray.
    """
    n = directions / np.linalg.norm(directions, axis=1, keepdims=True)
    helper = np.where(np.abs(n[:, :1]) < 0.7, [[1.0, 0.0, 0.0]], [[0.0, 1.0, 0.0]])
    x = np.cross(helper, n)
    x /= np.linalg.norm(x, axis=1, keepdims=True)
    poses = make_pose(np.stack([x, np.cross(n, x), n], axis=2), origins - STANDOFF * n)
    return [gtsam.Pose3(pose) for pose in poses]
