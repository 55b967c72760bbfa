"""The rules for data from outside: stamps, poses, covariances, cameras, boxes. Every reader and every push applies them."""

import math

import numpy as np

from objslam.core.arrays import Bools, Floats
from objslam.core.camera import COEFFICIENTS, Camera, RangeNoise

MAX_POSITION = 1e7
"""The bound of a coordinate or a depth, m. A larger bound accepts more wrong numbers. No place on earth is farther from the
origin of its UTM zone. At this bound, a float resolves 2 nm."""
MAX_STAMP = 1e20
"""The bound of a stamp in a file, s. A larger bound accepts more wrong numbers. A stamp that is in ns by mistake is below
the bound, so that the checks of a run can name the mistake."""
MAX_LIVE_STAMP = 1e11
"""The bound of a stamp of a running robot, s. A larger bound accepts more wrong numbers. At this bound, a float
resolves 15 us."""
NO_AREA = "box without area (x2 <= x1 or y2 <= y1)"
"""The reason for which a box without area is dropped."""
_LAST_DATE = 9e9
"""The Unix time, s, up to which a stamp counts as a date. A larger bound overflows the 64 bits of a time in ns."""
MAX_PIXEL = 1e7
"""The bound of a box corner and of an element of a camera matrix, px. A larger bound accepts more wrong numbers. The largest
image is a hundredth of this bound."""
MAX_SIDE = 1 << 16
"""The largest width and height of an image, px. A larger value accepts more wrong numbers. No robot's camera has more."""
MAX_DISTORTION = 1e6
"""The bound of a distortion coefficient. A larger bound accepts more wrong numbers. Calibrations that converged are far
below it."""
UNITS_OF_TIME = {1e3: "ms", 1e6: "us", 1e9: "ns"}
"""The name of each unit of time, by the number of units in a second."""
_DATES = (1e8, 1e10)
"""The range of stamps, s, of dates between 1973 and 2286. With a wider range, the unit of fewer stamps is unknown."""
_RIGID = 1e-3
"""The largest difference between R^T R and the identity in any entry. A larger value accepts worse rotations. Rotations that
are printed with four decimals are below it."""
_ROUNDING = 1e-12
"""The largest difference between R^T R and the identity in any entry at which R stays unchanged, bit by bit. A larger value
leaves more rotations inexact. A product of a hundred rotations is below it."""
_SHORTEST, _LONGEST = 1e-6, 1e3
"""The bounds of the length of a quaternion. Wider bounds accept more wrong quaternions. A valid quaternion has length 1, but
some programs do not normalise their quaternions."""
_ASYMMETRY = 1e-6
"""The largest difference between two mirrored entries of a covariance, as a share of the product of the two standard
deviations. A larger share accepts numbers that were rounded to fewer digits."""
_NOTHING = 1e-200
"""The largest variance, in the square of any unit, that counts as 0. Products of smaller numbers have few exact digits. With
a larger value, more correlations are not checked."""
_NEGATIVE = 1e-6
"""The tolerance of correlations. The least eigenvalue of a correlation matrix may be this far below 0, and a correlation may
be this far beyond 1. A larger value accepts numbers that were rounded to fewer digits."""


def valid_stamps(stamps: Floats, bound: float = MAX_STAMP) -> Bools:
    """Return which stamps (...), s, are finite and at most `bound` in absolute value."""
    return np.asarray(np.abs(stamps) <= bound)


def unit_of_date(stamp: float) -> str:
    """Return the unit of a stamp that is above `MAX_LIVE_STAMP`, if it is a date: "ms", "us", "ns" or "another unit"."""
    return next((unit for factor, unit in UNITS_OF_TIME.items() if _DATES[0] < stamp / factor < _DATES[1]), "another unit")


def valid_positions(positions: Floats) -> Bools:
    """Return which positions (..., 2) or (..., 3), m, are finite and below `MAX_POSITION` in each coordinate."""
    return np.asarray((np.abs(positions) < MAX_POSITION).all(axis=-1))


def is_valid_position(x: float, y: float, z: float) -> bool:
    """Return whether one position x, y, z, m, is valid by `valid_positions`. This takes a tenth of the time."""
    return -MAX_POSITION < x < MAX_POSITION and -MAX_POSITION < y < MAX_POSITION and -MAX_POSITION < z < MAX_POSITION


def lengths(vectors: Floats) -> Floats:
    """Return the lengths (...) of vectors (..., D) from outside. A length that is too large for a number is inf."""
    with np.errstate(over="ignore"):
        return np.asarray(np.linalg.norm(vectors, axis=-1))


def valid_pose_rows(rows: Floats) -> Bools:
    """Return which rows (N, 7) are poses: x, y, z, m, and a quaternion qx, qy, qz, qw of any length."""
    turns = np.asarray((np.abs(rows[:, 3:]) < _LONGEST).all(axis=1))
    turns &= np.linalg.norm(np.where(turns[:, None], rows[:, 3:], 0.0), axis=1) > _SHORTEST
    return turns & valid_positions(rows[:, :3])


def rigid_poses(poses: Floats) -> tuple[Floats, Bools]:
    """Return rigid poses (N, 4, 4) with exact rotations, and which of the poses (N, 4, 4) are rigid at all.

    A pose is rigid if its position is valid, its last row is 0, 0, 0, 1, and every entry of R^T R is within 1e-3 of the
    identity. The nearest exact rotation (Kabsch 1976) replaces a rotation that is off by more than rounding. The identity
    replaces a pose that is not rigid.
    """
    rotation = poses[:, :3, :3]
    sane = valid_positions(poses[:, :3, 3]) & np.asarray((np.abs(rotation) < 2).all(axis=(1, 2)))
    sane &= np.asarray((poses[:, 3] == [0.0, 0.0, 0.0, 1.0]).all(axis=1))
    exact = np.where(sane[:, None, None], poses, np.eye(4))
    rotation = exact[:, :3, :3]
    off = np.abs(np.swapaxes(rotation, 1, 2) @ rotation - np.eye(3)).max(axis=(1, 2))
    good = sane & (off <= _RIGID) & (np.linalg.det(rotation) > 0)
    inexact = np.flatnonzero(good & (off > _ROUNDING))
    left, _, right = np.linalg.svd(rotation[inexact])
    exact[inexact, :3, :3] = left @ right
    exact[~good] = np.eye(4)
    return exact, good


def rigid_pose(pose: Floats) -> Floats | None:
    """Return a rigid pose (4, 4) with an exact rotation, as `rigid_poses` does. None if the pose is not rigid."""
    if _is_exact(pose):
        return pose.copy()
    exact, good = rigid_poses(pose[None])
    return exact[0] if good[0] else None


def _is_exact(pose: Floats) -> bool:
    """Return whether a pose (4, 4) is rigid, and its rotation exact up to rounding.

    A session checks every pose, and nearly all are exact. This function avoids numpy, and takes a tenth of the time of
    `rigid_poses`.
    """
    (a, b, c, x), (d, e, f, y), (g, h, i, z), last = pose.tolist()
    if not is_valid_position(x, y, z) or last != [0.0, 0.0, 0.0, 1.0]:
        return False
    if not a * (e * i - f * h) - b * (d * i - f * g) + c * (d * h - e * g) > 0:
        return False
    return (
        -_ROUNDING <= a * a + d * d + g * g - 1 <= _ROUNDING
        and -_ROUNDING <= b * b + e * e + h * h - 1 <= _ROUNDING
        and -_ROUNDING <= c * c + f * f + i * i - 1 <= _ROUNDING
        and -_ROUNDING <= a * b + d * e + g * h <= _ROUNDING
        and -_ROUNDING <= a * c + d * f + g * i <= _ROUNDING
        and -_ROUNDING <= b * c + e * f + h * i <= _ROUNDING
    )


def covariance_fault(covariance: Floats) -> str | None:
    """Return what is wrong with covariances (..., P, P), in words that follow their name. None if all are valid.

    A covariance is finite, symmetric and not negative in any direction. Symmetry and sign are judged on the correlations,
    because the units of a covariance differ.
    """
    if not np.isfinite(covariance).all():
        return "has a number that is not finite"
    variance = np.diagonal(covariance, axis1=-2, axis2=-1)
    if (variance < 0).any():
        return "has a negative variance"
    sigma = np.sqrt(np.where(variance > _NOTHING, variance, 1.0))
    with np.errstate(over="ignore", under="ignore"):
        correlation = covariance / sigma[..., :, None] / sigma[..., None, :]
    mirrored = np.swapaxes(correlation, -1, -2)
    with np.errstate(invalid="ignore", over="ignore"):
        if not (np.abs(correlation - mirrored) <= _ASYMMETRY).all():
            return "is not symmetric"
    if not (np.abs(correlation) <= 1 + _NEGATIVE).all():
        return "has a correlation beyond 1"
    if covariance.size and np.linalg.eigvalsh((correlation + mirrored) / 2).min() < -_NEGATIVE:
        return "is negative in some direction"
    return None


def camera_fault(camera: Camera) -> str | None:
    """Return what is wrong with a camera whose fields have the right types, in words that follow "camera"; None if valid.

    The pose of the camera is checked, but not corrected. `rigid_pose` corrects it.
    """
    matrix = camera.matrix
    if (fault := _matrix_fault(matrix)) is not None:
        return fault
    if not (1 <= camera.width <= MAX_SIDE and 1 <= camera.height <= MAX_SIDE):
        return "without a size"
    distortion, counts = camera.distortion, COEFFICIENTS.get(camera.distortion_model, ())
    if distortion.ndim != 1 or not counts:
        return "with an unknown lens model"
    if len(distortion) not in counts:
        takes = " or ".join(map(str, counts))
        return f"whose lens model {camera.distortion_model} takes {takes} coefficients, got {len(distortion)}"
    if not (np.abs(distortion) < MAX_DISTORTION).all():
        return "whose distortion coefficients are not finite or too large"
    if camera.base_T_camera.shape != (4, 4) or not rigid_poses(camera.base_T_camera[None])[1][0]:
        return "whose mount is not a rigid pose"
    if not 0 < camera.depth_scale < math.inf:
        return "whose depth scale is not above zero"
    if camera.depth_noise is not None and not _possible(camera.depth_noise):
        return "whose depth noise is not a finite sigma above zero, and sigma_per_m and bias of at least zero"
    return None


def _matrix_fault(matrix: Floats) -> str | None:
    if matrix.shape != (3, 3) or not np.isfinite(matrix).all() or not matrix.any():
        return "without a calibration: its matrix is not (3, 3), not finite, or zero"
    if not (np.abs(matrix) < MAX_PIXEL).all():
        return f"whose matrix has an entry of {MAX_PIXEL:g} px or more"
    if matrix[1, 0] != 0 or not np.array_equal(matrix[2], [0, 0, 1]):
        return "whose matrix is not fx 0 cx, 0 fy cy, 0 0 1"
    if min(matrix[0, 0], matrix[1, 1]) < 1 / MAX_PIXEL:
        return f"whose focal length ({matrix[0, 0]:g}, {matrix[1, 1]:g}) px is not above zero"
    return None


def _possible(noise: RangeNoise) -> bool:
    numbers = (noise.sigma, noise.sigma_per_m, noise.bias)
    plain = all(isinstance(n, int | float | np.number) and math.isfinite(n) for n in numbers)
    return plain and noise.sigma > 0 and noise.sigma_per_m >= 0 and noise.bias >= 0


def is_date(stamp: float) -> bool:
    """Return whether a stamp, s, is Unix time. Such a stamp is above 1e8 s, about three years. Other clocks start at 0 and
    stay below it."""
    return 1e8 < stamp < _LAST_DATE


NO_LABEL = ""
"""The label of a box whose own label is missing or unusable. It is not a name, so the box is invalid."""


def is_name(value: object) -> bool:
    """Return whether a value is a printable text on one line that is not blank."""
    return isinstance(value, str) and value.isprintable() and bool(value.strip())


def box_rules(boxes: Floats, scores: Floats, names: Bools) -> tuple[tuple[Bools, str], ...]:
    """Return the rules for boxes (M, 4), px. Each has a mask (M,) of the boxes that obey the rule, and the reason to drop
    the others.

    scores: (M,). names: (M,) whether the label of each box `is_name`.
    """
    with np.errstate(invalid="ignore"):
        area = (boxes[:, 2] > boxes[:, 0]) & (boxes[:, 3] > boxes[:, 1])
    return (
        (np.asarray((np.abs(boxes) < MAX_PIXEL).all(axis=1)), "box with a corner that is not finite or too large"),
        (area, NO_AREA),
        ((scores >= 0) & (scores <= 1), "box with a score outside 0 to 1"),
        (names, "box with a label that is no printable text"),
    )


def valid_corners(corners: Floats) -> Bools:
    """Return which corners (M, 4, 2), px, are finite, not too large, and go around a convex quadrilateral."""
    with np.errstate(invalid="ignore", over="ignore"):
        known = np.asarray((np.abs(corners) < MAX_PIXEL).all(axis=(1, 2)))
        ahead = np.roll(corners, -1, axis=1) - corners
        after = np.roll(ahead, -1, axis=1)
        turn = ahead[..., 0] * after[..., 1] - ahead[..., 1] * after[..., 0]
        return known & np.asarray((turn > 0).all(axis=1) | (turn < 0).all(axis=1))


def valid_depths(depths: Floats) -> Bools:
    """Return which depths (...), m, are above zero and below `MAX_POSITION`."""
    return np.asarray((depths > 0) & (depths < MAX_POSITION))
