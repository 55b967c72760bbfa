"""Hypotheses about base_T_camera: the mistakes that people make with a mount, and all turns by right angles.

A mount that is written in other axes, or measured from another side, differs from the true one by right angles. So the
turns by right angles cover the mistakes that nobody thought of. They also show what wrong mounts look like in this log: at
most one of them is right.
"""

from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from itertools import permutations, product

import numpy as np

from objslam.core.arrays import Floats
from objslam.core.geometry import inverse, make_pose
from objslam.core.rotation import quaternion_from_rotation, rotation_from_quaternion, rotation_from_vector, rotation_vector
from objslam.core.types import Log
from objslam.mapping.checks.hypotheses.hypothesis import Hypothesis, with_cameras

_OPTICAL = make_pose(np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]), np.zeros(3))
"""The pose of an optical frame (x right, y down, z forward) in a body frame (x forward, y left, z up)."""
_SIDES = {"ahead": 0, "to the left": 90, "back": 180, "to the right": -90}
"""The usual directions in which a camera looks, as headings on the robot (degrees)."""
_SAME = 1e-3
"""The largest difference of the entries of two rotation matrices that are the same mount. A larger value tries fewer."""


def mounts(log: Log) -> Iterator[Hypothesis]:
    """Yield each hypothesis about the mounts of a log. Yield nothing if all cameras move on the robot."""
    if all(one.mount is not None for one in log.cameras):
        return
    tried = [_rotations(log)]
    for one in (*_usual(log), *_turns()):
        rotations = _rotations(one.put_right(log))
        # The usual mistakes may have the same effect. Then all their causes are named.
        others = np.array(tried[:1] if one.usual else tried)
        if not np.isclose(rotations, others, atol=_SAME).all(axis=(1, 2, 3)).any():
            tried.append(rotations)
            yield one


def unset(log: Log) -> bool:
    """Return whether no base_T_camera of a log has a rotation."""
    return all(np.allclose(one.camera.base_T_camera[:3, :3], np.eye(3), atol=_SAME) for one in log.cameras)


def w_last(poses: Floats) -> Floats:
    """Return corrected poses (..., 4, 4) whose quaternions were stored with w first, but were read with w last."""
    read = quaternion_from_rotation(poses[..., :3, :3])
    return make_pose(rotation_from_quaternion(np.roll(read, -1, axis=-1)), poses[..., :3, 3])


def _usual(log: Log) -> Iterator[Hypothesis]:
    yield _mount("mount inverted", "base_T_camera inverted", "base_T_camera is probably camera_T_base", inverse)
    if unset(log):
        for side, degrees in _SIDES.items():
            turn = make_pose(rotation_from_vector(np.array([0.0, 0.0, np.radians(degrees)])), np.zeros(3))
            yield _mount(
                f"mount unset, {side}",
                f"a camera that looks {side}",
                "base_T_camera is not set, or it has the axes of a body and not of an optical frame",
                partial(_turned_in_camera, turn=turn @ _OPTICAL),
            )
        return
    cause = "base_T_camera probably has the axes of a body (x forward) instead of the axes of an optical frame (z forward)"
    to_optical = partial(_turned_in_camera, turn=_OPTICAL)
    yield _mount("mount axes", "the axes of an optical frame in base_T_camera", cause, to_optical)
    cause = "the quaternion of base_T_camera is probably w x y z instead of x y z w"
    yield _mount("mount wxyz", "the quaternion of base_T_camera read as w x y z", cause, w_last)
    cause = "the yaw of base_T_camera probably has the wrong sign"
    yield _mount("mount yaw sign", "the yaw of base_T_camera negated", cause, partial(_mirrored, axis=1))
    cause = "the tilt of base_T_camera (up or down) probably has the wrong sign"
    yield _mount("mount tilt sign", "the tilt of base_T_camera negated", cause, partial(_mirrored, axis=2))


def _turns() -> Iterator[Hypothesis]:
    """Yield each turn by right angles, about axes of base and about axes of the camera."""
    for of_camera, rotation in product((False, True), _right_angles()):
        words = _in_words(rotation, of_camera)
        change = partial(_turned_in_camera if of_camera else _turned_in_base, turn=make_pose(rotation, np.zeros(3)))
        name = f"mount turned, {words}"
        cause = "base_T_camera has axes of another convention, or the camera is mounted in another way"
        yield _mount(name, f"base_T_camera turned by about {words}", cause, change, usual=False)


def _right_angles() -> Iterator[Floats]:
    """Yield all rotations (3, 3) by right angles except the identity. Rotations about the vertical axis come first."""
    found = []
    for order, signs in product(permutations(range(3)), product((1.0, -1.0), repeat=3)):
        matrix = np.eye(3)[list(order)] * np.array(signs)[:, None]
        if np.linalg.det(matrix) > 0 and not np.allclose(matrix, np.eye(3)):
            found.append(matrix)
    yield from sorted(found, key=lambda turn: -turn[2, 2])


def _in_words(rotation: Floats, of_camera: bool) -> str:
    """Return the angle and the axis of a rotation (3, 3), such as "90 degrees about z of base"."""
    vector = rotation_vector(rotation)
    angle = float(np.linalg.norm(vector))
    axis = np.round(vector / np.abs(vector).max()).astype(int)
    degrees = round(np.degrees(angle))
    if np.count_nonzero(axis) == 1:
        where = int(np.flatnonzero(axis)[0])
        degrees, name = degrees * int(axis[where]) if degrees < 180 else degrees, "xyz"[where]
    else:
        name = f"({', '.join(str(value) for value in axis)})"
    return f"{degrees} degrees about {name} of {'the camera' if of_camera else 'base'}"


def _mount(name: str, what: str, cause: str, change: Callable[[Floats], Floats], *, usual: bool = True) -> Hypothesis:
    def put_right(log: Log) -> Log:
        return with_cameras(
            log, lambda one: replace(one, camera=replace(one.camera, base_T_camera=change(one.camera.base_T_camera)))
        )

    return Hypothesis(name, what, cause, put_right, of_mount=True, usual=usual)


def _rotations(log: Log) -> Floats:
    return np.array([one.camera.base_T_camera[:3, :3] for one in log.cameras])


def _turned_in_camera(pose: Floats, turn: Floats) -> Floats:
    return pose @ turn


def _turned_in_base(pose: Floats, turn: Floats) -> Floats:
    """Return a mount with its rotation turned about the axes of base. The camera stays where it is."""
    return make_pose(turn[:3, :3] @ pose[:3, :3], pose[:3, 3])


def _mirrored(pose: Floats, axis: int) -> Floats:
    """Return a mount that looks where its mirror image looks. axis: the axis of base that is reversed, 1 for y, 2 for z.

    A mirrored frame would be left-handed. So one axis of the camera is reversed as well: x together with y of base, or y
    together with z of base.
    """
    base, camera = np.eye(3), np.eye(3)
    base[axis, axis] = camera[axis - 1, axis - 1] = -1.0
    return make_pose(base @ pose[:3, :3] @ camera, pose[:3, 3])
