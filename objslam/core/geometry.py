"""Rigid geometry on batches of poses, which are homogeneous matrices (..., 4, 4).

Twists have the order of GTSAM, rotation first: (wx, wy, wz, vx, vy, vz).
"""

import math
from collections.abc import Sequence
from functools import lru_cache
from typing import Literal, NamedTuple

import numpy as np

from objslam.core.arrays import Bools, Floats, Ints
from objslam.core.rotation import (
    cross,
    quaternion_from_rotation,
    rotation_from_quaternion,
    rotation_from_vector,
    rotation_vector,
    skew,
)

_SMALL = 1e-4
"""The angle (rad) of a twist below which a series replaces its coefficients. A larger value makes the series less exact. At
this value, its relative error is below 1e-17."""
_ON_A_LINE = 1e-9
"""The largest second singular value of the cross-covariance of points on a line, as a share of the first one. A larger share
treats more point sets as lines. Rounding leaves about 1e-15."""
_FEW_POINTS = 100
"""The most points between which all distances are computed. For more points, a search tree takes less time. Few points do
not need a tree, whose import from scipy.spatial takes 0.07 s."""


def make_pose(rotation: Floats, translation: Floats) -> Floats:
    """Make poses (..., 4, 4) from rotations (..., 3, 3) and translations (..., 3), m."""
    shape = np.broadcast_shapes(rotation.shape[:-2], translation.shape[:-1])
    pose = np.zeros((*shape, 4, 4))
    pose[..., :3, :3] = rotation
    pose[..., :3, 3] = translation
    pose[..., 3, 3] = 1.0
    return pose


def inverse(pose: Floats) -> Floats:
    """Return the inverse of rigid poses (..., 4, 4)."""
    back, rotation = np.zeros(pose.shape), pose[..., :3, :3]
    back[..., :3, :3] = np.swapaxes(rotation, -1, -2)
    back[..., :3, 3] = -np.einsum("...ji,...j->...i", rotation, pose[..., :3, 3])
    back[..., 3, 3] = 1.0
    return back


def pose_from_quaternion(translation: Floats, xyzw: Floats) -> Floats:
    """Make poses (N, 4, 4) from translations (N, 3), m, and quaternions (N, 4) x, y, z, w of any length above zero."""
    return make_pose(rotation_from_quaternion(xyzw), translation)


def quaternion(pose: Floats) -> Floats:
    """Return the unit quaternions (N, 4) x, y, z, w with w >= 0 of poses (N, 4, 4)."""
    return quaternion_from_rotation(pose[..., :3, :3])


def lift_se2(xy_yaw: Floats) -> Floats:
    """Lift SE(2) poses (..., 3) x, y (m), yaw (rad) to SE(3) poses (..., 4, 4) with z = roll = pitch = 0."""
    cos, sin = np.cos(xy_yaw[..., 2]), np.sin(xy_yaw[..., 2])
    pose = np.zeros((*xy_yaw.shape[:-1], 4, 4))
    pose[..., 0, 0] = pose[..., 1, 1] = cos
    pose[..., 1, 0] = sin
    pose[..., 0, 1] = -sin
    pose[..., 2, 2] = pose[..., 3, 3] = 1.0
    pose[..., :2, 3] = xy_yaw[..., :2]
    return pose


def split_se2(pose: Floats) -> tuple[Floats, Floats]:
    """Split SE(3) poses (..., 4, 4) into their SE(2) part (..., 3) x, y, yaw and the remainder (..., 4, 4).

    lift_se2(part) @ remainder is the pose. The yaw is the heading of the x axis seen from above, and 0 for a vertical x
    axis.
    """
    yaw = np.arctan2(pose[..., 1, 0], pose[..., 0, 0])
    part = np.stack([pose[..., 0, 3], pose[..., 1, 3], yaw], axis=-1)
    return part, inverse(lift_se2(part)) @ pose


def is_planar(poses: Floats) -> bool:
    """Return whether all poses (N, 4, 4) have one height, roll and pitch, as on an SE(2) path with a constant offset.
    Heights (m) and axes may differ by 1e-6."""
    if len(poses) == 0:
        return True
    x_axis, y_axis = poses[:, 0, :3], poses[:, 1, :3]  # The axes of the map, in the frame of each pose.
    yaw = np.arctan2(poses[:, 1, :1], poses[:, 0, :1])
    cos, sin = np.cos(yaw), np.sin(yaw)
    remainder = poses[:, 2], cos * x_axis + sin * y_axis, cos * y_axis - sin * x_axis
    return all(bool(np.abs(part - part[:1]).max() <= 1e-6) for part in remainder)


def log_se3(pose: Floats) -> Floats:
    """Return the logarithms (N, 6) of poses (N, 4, 4). The exponential of the result is the pose."""
    omega = rotation_vector(pose[..., :3, :3])
    squared, small, divisor = _squares(omega)
    half = np.sqrt(divisor) / 2
    share = np.where(small, 1 / 12 + squared / 720, (1 - half / np.tan(half)) / divisor)
    place = pose[..., :3, 3]
    once = cross(omega, place)  # The inverse of the left Jacobian, times the place (Barfoot, eq. 8.35).
    twist = np.empty((*omega.shape[:-1], 6))
    twist[..., :3] = omega
    twist[..., 3:] = place - once / 2 + share[..., None] * cross(omega, once)
    return twist


def twist_lengths(pose: Floats) -> tuple[Floats, Floats]:
    """Return the norms of the halves of `log_se3` of poses (N, 4, 4): rotation (N,), rad, and translation (N,), m."""
    r, t = pose[:, :3, :3], pose[:, :3, 3]
    axis = np.stack([r[:, 2, 1] - r[:, 1, 2], r[:, 0, 2] - r[:, 2, 0], r[:, 1, 0] - r[:, 0, 1]], axis=1) / 2
    sine = np.sqrt((axis * axis).sum(axis=1))
    turn = np.arctan2(sine, (np.trace(r, axis1=1, axis2=2) - 1) / 2)
    along2 = ((t * axis).sum(axis=1) / np.maximum(sine, 1e-150)) ** 2
    chord = np.maximum((t * t).sum(axis=1) - along2, 0.0)
    return turn, np.sqrt(along2 + chord / np.sinc(turn / (2 * np.pi)) ** 2)


class Motion(NamedTuple):
    """The motion between two poses (4, 4), as floats, in the frame of the map and not of the body.

    axis: the unit axis of the rotation, times the sine of its angle. angle: rad, in [0, pi]. way: m, the shift.
    """

    axis: tuple[float, float, float]
    angle: float
    way: tuple[float, float, float]


def motion_between(before: Floats, after: Floats) -> Motion:
    """Return the motion between two poses (4, 4), in a tenth of the time that numpy takes. A session needs it for every
    pose."""
    (a0, a1, a2, ax), (b0, b1, b2, by), (c0, c1, c2, cz) = before[:3].tolist()
    (d0, d1, d2, dx), (e0, e1, e2, ey), (f0, f1, f2, fz) = after[:3].tolist()
    trace = a0 * d0 + b0 * e0 + c0 * f0 + a1 * d1 + b1 * e1 + c1 * f1 + a2 * d2 + b2 * e2 + c2 * f2
    # The rotation axis times the sine of the angle is half the sum of the cross products of the axes before and after.
    u = (b0 * f0 - c0 * e0 + b1 * f1 - c1 * e1 + b2 * f2 - c2 * e2) / 2
    v = (c0 * d0 - a0 * f0 + c1 * d1 - a1 * f1 + c2 * d2 - a2 * f2) / 2
    w = (a0 * e0 - b0 * d0 + a1 * e1 - b1 * d1 + a2 * e2 - b2 * d2) / 2
    angle = math.atan2(math.sqrt(u * u + v * v + w * w), (trace - 1) / 2)
    return Motion((u, v, w), angle, (dx - ax, ey - by, fz - cz))


def twist_length(before: Floats, after: Floats) -> tuple[float, float]:
    """Return the two numbers of `twist_lengths` for the motion between two poses (4, 4), ten times faster."""
    (u, v, w), turn, (x, y, z) = motion_between(before, after)
    sine = math.sqrt(u * u + v * v + w * w)
    along2 = ((x * u + y * v + z * w) / max(sine, 1e-150)) ** 2
    chord = max(x * x + y * y + z * z - along2, 0.0)
    half = turn / 2
    stretch = math.sin(half) / half if half > 0 else 1.0
    return turn, math.sqrt(along2 + chord / stretch**2)


def exp_se3(twist: Floats) -> Floats:
    """Return the exponential (N, 4, 4) of twists (N, 6) (Barfoot, State Estimation for Robotics, eq. 8.31-8.35)."""
    omega, place = twist[..., :3], twist[..., 3:]
    squared, small, divisor = _squares(omega)
    angle = np.sqrt(divisor)
    a = np.where(small, 0.5 - squared / 24, (1 - np.cos(angle)) / divisor)[..., None]
    b = np.where(small, 1 / 6 - squared / 120, (angle - np.sin(angle)) / (divisor * angle))[..., None]
    once = cross(omega, place)
    return make_pose(rotation_from_vector(omega), place + a * once + b * cross(omega, once))


def _squares(omega: Floats) -> tuple[Floats, Bools, Floats]:
    """Return for rotation vectors (..., 3) three arrays (...): the squares of the angles, whether each angle is so small
    that a series is needed, and the squares as divisors, in which 1 replaces the squares of small angles."""
    squared = np.einsum("...i,...i->...", omega, omega)
    small = squared < _SMALL**2
    return squared, small, np.where(small, 1.0, squared)


def lengths(vectors: Floats) -> Floats:
    """Return the lengths (...) of vectors (..., D), in a fifth of the time that `np.linalg.norm` takes along an axis."""
    return np.asarray(np.sqrt(np.einsum("...i,...i->...", vectors, vectors)))


def adjoint(pose: Floats) -> Floats:
    """Return the adjoint matrices (..., 6, 6) of poses (..., 4, 4)."""
    rotation = pose[..., :3, :3]
    result = np.zeros((*pose.shape[:-2], 6, 6))
    result[..., :3, :3] = result[..., 3:, 3:] = rotation
    result[..., 3:, :3] = skew(pose[..., :3, 3]) @ rotation
    return result


def interpolate(stamps: Floats, poses: Floats, query: Floats, max_gap: float) -> tuple[Floats, Bools]:
    """Interpolate poses between two neighbours by a constant twist, and extrapolate nothing. Planar poses stay planar.

    stamps: (N,) s, increasing. poses: (N, 4, 4) at the stamps. query: (Q,) s. max_gap: s, the longest gap between two
    neighbours. Returns the poses (Q, 4, 4), and whether each is valid (Q,). A query outside the path or inside a longer gap
    gives the identity and is not valid.
    """
    if len(stamps) == 0:
        return np.broadcast_to(np.eye(4), (len(query), 4, 4)).copy(), np.zeros(len(query), dtype=bool)
    after = np.clip(np.searchsorted(stamps, query, side="right"), 1, max(len(stamps) - 1, 1))
    before = after - 1
    after = np.minimum(after, len(stamps) - 1)
    span = stamps[after] - stamps[before]
    exact = (query == stamps[before]) | (query == stamps[after])
    inside = (query >= stamps[0]) & (query <= stamps[-1])
    valid = inside & ((span <= max_gap) | exact)
    fraction = np.divide(query - stamps[before], span, out=np.zeros(len(query)), where=span > 0)
    if not valid.all():
        before, after, fraction = before[valid], after[valid], fraction[valid]
    first = poses[before]
    if len(first) >= len(stamps) > 1:  # Many queries share a twist, so each twist is computed once.
        twist = log_se3(inverse(poses[:-1]) @ poses[1:])[before]
    else:
        twist = log_se3(inverse(first) @ poses[after])
    between = first @ exp_se3(twist * fraction[:, None])
    if len(between) == len(query):
        return between, valid
    result = np.broadcast_to(np.eye(4), (len(query), 4, 4)).copy()
    result[valid] = between
    return result, valid


def interpolate_pair(first: Floats, second: Floats, share: float) -> Floats:
    """Return the pose (4, 4) at a share, 0 to 1, of the way between two poses (4, 4), as `interpolate`.

    A session needs it for every image. This function avoids numpy, and takes a tenth of the time of `interpolate`.
    """
    axis, angle, way = motion_between(first, second)
    if angle >= math.pi / 2:  # The sine of an angle near pi is small, so that the axis would be inexact.
        poses, _ = interpolate(np.array([0.0, 1.0]), np.array([first, second]), np.array([share]), np.inf)
        return poses[0]
    longer, half, turned = angle / math.sin(angle) if angle > 0 else 1.0, angle / 2, share * angle
    small = angle < _SMALL
    k = 1 / 12 + angle**2 / 720 if small else (1 - half / math.tan(half)) / angle**2
    a = 0.5 - turned**2 / 24 if turned < _SMALL else (1 - math.cos(turned)) / turned**2
    b = 1 / 6 - turned**2 / 120 if turned < _SMALL else (turned - math.sin(turned)) / turned**3
    # As in `log_se3` and `exp_se3`, but in the frame of the map, not of the first pose.
    once = _product(axis, way)
    twice = _product(axis, once)
    straight = [share * (p - longer * q / 2 + k * longer**2 * r) for p, q, r in zip(way, once, twice, strict=True)]
    u, v, w = (share * longer * n for n in axis)
    once = _product((u, v, w), straight)
    twice = _product((u, v, w), once)
    x, y, z = (p + a * q + b * r for p, q, r in zip(straight, once, twice, strict=True))
    c = math.cos(turned)
    sine = 1 - turned**2 / 6 if turned < _SMALL else math.sin(turned) / turned
    turn = np.array(
        [
            [c + a * u * u, a * u * v - sine * w, a * u * w + sine * v],
            [a * u * v + sine * w, c + a * v * v, a * v * w - sine * u],
            [a * u * w - sine * v, a * v * w + sine * u, c + a * w * w],
        ]
    )
    pose = first.copy()
    pose[:3, :3] = turn @ first[:3, :3]
    pose[:3, 3] += x, y, z
    return pose


def _product(a: Sequence[float], b: Sequence[float]) -> tuple[float, float, float]:
    """Return the cross product of two vectors, as floats."""
    (x, y, z), (u, v, w) = a, b
    return y * w - z * v, z * u - x * w, x * v - y * u


def align(source: Floats, target: Floats, kind: Literal["none", "se2", "sim2", "se3", "sim3"]) -> tuple[Floats, float]:
    """Return the pose (R, t) (4, 4) and the scale that align source points (N, 3) with target points (N, 3) (Umeyama 1991).

    Then scale * R @ source + t is nearest to target in least squares. The kind `none` gives the identity. `se2` estimates
    the yaw and the whole translation, and `se3` the full rotation. `sim2` and `sim3` add a scale. R is never a reflection.
    With fewer than 2 points (3 for `se3` and `sim3`), only the translation is estimated. Points on a line do not determine
    the rotation about the line. For such points, R is the smallest of the best rotations.
    """
    if kind == "none" or len(source) == 0:
        return np.eye(4), 1.0
    mean_s, mean_t = source.mean(axis=0), target.mean(axis=0)
    a, b = source - mean_s, target - mean_t
    rotation, scale = np.eye(3), 1.0
    if kind in ("se3", "sim3"):
        if len(source) >= 3:
            rotation, shared = _best_rotation(a, b)
            spread = float((a**2).sum())
            if kind == "sim3" and spread > 0 and shared > 0:
                scale = shared / spread
    elif len(source) >= 2:
        dot = float((a[:, :2] * b[:, :2]).sum())
        cross = float((a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]).sum())
        rotation = lift_se2(np.array([0.0, 0.0, np.arctan2(cross, dot)]))[:3, :3]
        spread = float((a[:, :2] ** 2).sum())
        if kind == "sim2" and spread > 0:
            scale = float(np.hypot(dot, cross)) / spread
    return make_pose(rotation, mean_t - scale * rotation @ mean_s), scale


def _best_rotation(a: Floats, b: Floats) -> tuple[Floats, float]:
    """Return the rotation R (3, 3) with the largest sum of dot products of R a and b, both (N, 3), and this sum."""
    u, size, vt = np.linalg.svd(b.T @ a)
    if size[0] > 0 and size[1] <= _ON_A_LINE * size[0]:
        from scipy.spatial.transform import Rotation

        return Rotation.align_vectors(u[:, :1].T, vt[:1])[0].as_matrix(), float(size[0])
    sign = np.sign(np.linalg.det(u @ vt))
    return u @ np.diag([1.0, 1.0, sign]) @ vt, float(size[0] + size[1] + sign * size[2])


def widest_angle(directions: Floats) -> float:
    """Return the widest angle (rad) between any two lines with unit directions (N, 3).

    Two opposite directions have the angle 0. If there are more than 400 lines, only the extremes along the main axes are
    compared.
    """
    if len(directions) < 2:
        return 0.0
    if len(directions) > 400:
        _, _, axes = np.linalg.svd(directions - directions.mean(axis=0), full_matrices=False)
        order = np.argsort(directions @ axes.T, axis=0)
        directions = directions[np.unique(np.concatenate([order[:60].ravel(), order[-60:].ravel()]))]
    return float(np.arccos(np.clip(np.abs(directions @ directions.T), 0.0, 1.0).min()))


def angles_off(origins: Floats, directions: Floats, points: Floats) -> Floats:
    """Return the angles (...), rad in [0, pi], by which unit directions (..., 3) from origins (..., 3) miss points
    (..., 3)."""
    to = points - origins
    return np.arctan2(lengths(cross(to, directions)), np.einsum("...i,...i->...", to, directions))


@lru_cache(maxsize=8)
def evenly_spread(number: int) -> Floats:
    """Return unit directions (number, 3) spread evenly over the sphere (a Fibonacci lattice). They are read-only."""
    k = np.arange(number) + 0.5
    z, azimuth = 1 - 2 * k / number, k * (np.pi * (3 - np.sqrt(5)))
    radius = np.sqrt(1 - z**2)
    directions = np.stack([radius * np.cos(azimuth), radius * np.sin(azimuth), z], axis=1)
    directions.flags.writeable = False  # All callers share them.
    return directions


def nearest_points(points: Floats, count: int) -> Ints:
    """Return for each of the points (N, 3) the indices (N, count) of the `count` nearest points, in any order. The point
    itself is one of them."""
    if len(points) <= _FEW_POINTS:
        squared = sum((points[:, [axis]] - points[:, axis]) ** 2 for axis in range(3))
        return np.argpartition(squared, count - 1, axis=1)[:, :count]
    from scipy.spatial import cKDTree

    return np.asarray(cKDTree(points).query(points, k=np.arange(1, count + 1))[1])
