"""Where a box lies in its image: the angle between the ray and the object, or Eq. 1's distance of the object from the ray.

The geometry is vectorised first, so that only the construction itself is left to Python.
"""

from __future__ import annotations

from collections.abc import Sequence

import gtsam
import numpy as np

from objslam.core.arrays import Floats, Ints
from objslam.core.geometry import make_pose
from objslam.graph.variables import L0, X0

STANDOFF = 1e7
"""How far behind its ray a virtual camera stands (m): far enough that perspective is gone (the relative error is the range
divided by it), near enough that rounding (it times 1e-16) is a nanometre."""
L1_RADIANS = 1e-4
"""The angle (rad) below which the loss `l1` on bearings is quadratic, so that it has a derivative at 0. Chosen far below the
noise of a box (a twentieth of a pixel); larger is smoother, and less like a norm."""
EQ1_SIGMA = 0.05
"""The standard deviation (m) of the point-to-line distance where poses are solved too. Eq. 1 knows no noise: this one weighs
its metres against the odometry's; larger trusts the odometry more."""
_ORTHOGRAPHIC = gtsam.Cal3DS2(STANDOFF, STANDOFF, 0, 0, 0, 0, 0, 0, 0)
_CENTRE = np.zeros(2)


def bearings(
    keyframe: Ints, directions: Floats, landmark: Ints, noise: Sequence[gtsam.noiseModel.Base]
) -> list[gtsam.NonlinearFactor]:
    """The angle off the ray (rad) between X(keyframe) and L(landmark): directions (R, 3) in the camera frame."""
    make, unit = gtsam.BearingFactor3D, gtsam.Unit3
    return [
        make(X0 + k, L0 + j, unit(direction), model)
        for direction, model, k, j in zip(directions, noise, keyframe.tolist(), landmark.tolist(), strict=True)
    ]


def point_to_line(
    keyframe: Ints, directions: Floats, landmark: Ints, noise: Sequence[gtsam.noiseModel.Base]
) -> list[gtsam.NonlinearFactor]:
    """Eq. 1 with the pose as a variable: directions (R, 3) in the camera frame, residual in metres."""
    make, bodies = gtsam.GenericProjectionFactorCal3DS2, virtual_cameras(np.zeros_like(directions), directions)
    return [
        make(_CENTRE, model, X0 + k, L0 + j, _ORTHOGRAPHIC, False, False, body)
        for body, model, k, j in zip(bodies, noise, keyframe.tolist(), landmark.tolist(), strict=True)
    ]


def point_to_line_fixed(
    origins: Floats, directions: Floats, landmark: Ints, noise: Sequence[gtsam.noiseModel.Base]
) -> list[gtsam.NonlinearFactor]:
    """Eq. 1 with known poses: the residual's norm is the distance (m) of L(landmark) to the ray (R, 3), (R, 3) in map."""
    make, camera = gtsam.TriangulationFactorCal3DS2, gtsam.PinholeCameraCal3DS2
    return [
        make(camera(pose, _ORTHOGRAPHIC), _CENTRE, model, L0 + j)
        for pose, model, j in zip(virtual_cameras(origins, directions), noise, landmark.tolist(), strict=True)
    ]


def virtual_cameras(origins: Floats, directions: Floats) -> list[gtsam.Pose3]:
    """For each ray (R, 3), (R, 3) a far camera that looks along it: its image is the offset across the ray, in metres."""
    n = directions / np.linalg.norm(directions, axis=1, keepdims=True)
    helper = np.where(np.abs(n[:, :1]) < 0.7, [[1.0, 0.0, 0.0]], [[0.0, 1.0, 0.0]])
    x = np.cross(helper, n)
    x /= np.linalg.norm(x, axis=1, keepdims=True)
    poses = make_pose(np.stack([x, np.cross(n, x), n], axis=2), origins - STANDOFF * n)
    return [gtsam.Pose3(pose) for pose in poses]
