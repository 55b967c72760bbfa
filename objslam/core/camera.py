"""A calibrated camera with its projection, undistortion and field of view."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Literal

import numpy as np
from numpy.polynomial.polynomial import polyder, polyval

from objslam.core.arrays import Bools, Floats, Ints
from objslam.core.geometry import lengths

DistortionModel = Literal["plumb_bob", "rational_polynomial", "equidistant"]

COEFFICIENTS: dict[DistortionModel, tuple[int, ...]] = {
    "plumb_bob": (4, 5),
    "rational_polynomial": (8, 12, 14),
    "equidistant": (4,),
}
"""The numbers of distortion coefficients that each model accepts."""

_STEPS, _FINER = 2000, 4  # Angles of a grid and number of grids in the search for a lens's fold. More are more exact.
_ALONG = 200  # The number of pieces of an image side in the sum for the solid angle. More pieces are slower and more exact.
_LEAST = 1e-9  # The least solid angle of a camera, sr. It keeps a division by the solid angle finite.
_TURNS, _EXACT, _FLAT = 60, 1e-14, 1e-12  # The most Newton iterations, the step to stop at (rad) and the least divisor.


@dataclass(frozen=True)
class RangeNoise:
    """The noise of the depths of one sensor, as standard deviations.

    sigma: m, the constant part. sigma_per_m: the part that grows with the distance, m per m. bias: m, the part that all
    ranges of one object share.
    """

    sigma: float
    sigma_per_m: float
    bias: float


@dataclass(frozen=True)
class Camera:
    """A calibrated camera with the fields of ROS camera_info, and its pose on the robot.

    matrix: (3, 3) px. distortion: (D,) coefficients. base_T_camera: (4, 4) the pose of the optical frame in base.
    depth_scale: the units of a depth image per metre. sees_size: whether the boxes show how large the objects are. A box
    that only marks a bearing shows no size. depth_noise: the noise of the camera's depths, None for the noise in the
    settings `depth`.
    """

    name: str
    width: int
    height: int
    matrix: Floats
    distortion_model: DistortionModel = "plumb_bob"
    distortion: Floats = field(default_factory=lambda: np.zeros(5))
    base_T_camera: Floats = field(default_factory=lambda: np.eye(4))
    depth_scale: float = 1000.0
    sees_size: bool = True
    depth_noise: RangeNoise | None = None

    @cached_property
    def focal(self) -> float:
        """Geometric mean of fx and fy, px."""
        return float(np.sqrt(self.matrix[0, 0] * self.matrix[1, 1]))

    @cached_property
    def size(self) -> Floats:
        """(2,) width and height of the image, px."""
        return np.array([self.width, self.height], dtype=np.float64)

    @cached_property
    def inverse_matrix(self) -> Floats:
        """(3, 3) matrix from homogeneous pixels to directions with z = 1."""
        return np.asarray(np.linalg.inv(self.matrix), dtype=np.float64)

    @cached_property
    def fisheye(self) -> bool:
        """Whether the image radius of a point grows with the angle of the point to the optical axis, not with its
        tangent."""
        return self.distortion_model == "equidistant"

    @cached_property
    def lens_angle(self) -> float:
        """The angle to the optical axis, rad, at which the lens model folds back. It is at most 90 degrees.

        Beyond the fold, a larger angle gives a smaller image radius, so the model projects invisible points into the image.
        A fisheye lens may see beyond 90 degrees, but OpenCV calibrates it with points of z > 0 only.
        """
        if not self.distortion.any():
            return np.pi / 2
        angle = np.linspace(0.0, np.pi / 2, _STEPS, endpoint=False)
        for _ in range(_FINER):
            grows = _growth(self, angle) > 0
            if grows.all():
                return np.pi / 2
            first = int(np.argmin(grows))
            angle = np.linspace(angle[first - 1], angle[first], _STEPS)
        return float(angle[0])

    @cached_property
    def view_angle(self) -> float:
        """The largest angle, rad, between the optical axis and a point on the image edge. It is at most `lens_angle`."""
        directions, valid = undistort(self, _edge(0.0, self.width - 1, self.height - 1, 32))
        return float(np.arccos(np.clip(directions[:, 2], -1.0, 1.0)).max()) if valid.all() else self.lens_angle

    @cached_property
    def solid_angle(self) -> float:
        """The solid angle of the image, sr.

        It is the sum of spherical triangles between the optical axis and the pieces of the image edge. Where the edge is
        outside the lens field, sectors of the cone with the angle `lens_angle` replace the triangles.
        """
        edge = _edge(-0.5, self.width - 0.5, self.height - 0.5, _ALONG)
        here, valid = undistort(self, edge)
        flat = edge - self.matrix[:2, 2]
        around = np.arctan2(flat[:, 1] / self.matrix[1, 1], flat[:, 0] / self.matrix[0, 0])
        sin, cos = np.sin(self.lens_angle), np.cos(self.lens_angle)
        rim = np.column_stack([sin * np.cos(around), sin * np.sin(around), np.full(len(edge), cos)])
        here = np.where(valid[:, None], here, rim)
        then = np.roll(here, -1, axis=0)
        turned = (np.roll(around, -1) - around + np.pi) % (2 * np.pi) - np.pi
        volume = here[:, 0] * then[:, 1] - here[:, 1] * then[:, 0]
        triangles = 2 * np.arctan2(volume, 1 + here[:, 2] + then[:, 2] + (here * then).sum(axis=1))
        outside = ~valid & ~np.roll(valid, -1)
        return max(abs(float(np.where(outside, turned * (1 - cos), triangles).sum())), _LEAST)


def spoken_name(name: str) -> str:
    """Return the name of a camera for a message: "camera front", but "camera" for a camera with the name "camera"."""
    return name if name == "camera" else f"camera {name}"


def undistort(camera: Camera, pixels: Floats) -> tuple[Floats, Bools]:
    """Return for each of the raw pixels (N, 2) the unit direction (N, 3) in the camera frame, and whether it is valid (N,).

    A direction is valid if it is `in_field`. For plumb_bob and rational_polynomial it must also project to within 0.1 px of
    its pixel. cv2.undistortPoints, iterated to convergence, inverts these two models. Newton's method inverts the pixels
    that OpenCV misses, and all pixels of the model equidistant (Kannala-Brandt).
    """
    if len(pixels) == 0:
        return np.zeros((0, 3)), np.zeros(0, dtype=bool)
    if camera.fisheye:
        return _undistort_fisheye(camera, pixels)
    if not camera.distortion.any():
        finite: Bools = np.asarray(np.isfinite(pixels).all(axis=1))
        pixels = pixels if finite.all() else np.where(finite[:, None], pixels, 0.0)
        straight = pixels @ camera.inverse_matrix[:, :2].T + camera.inverse_matrix[:, 2]
        return straight / lengths(straight)[:, None], finite
    import cv2  # Deferred: the import takes 0.02 s, and many logs have undistorted boxes.

    points = np.ascontiguousarray(pixels, dtype=np.float64)[:, None, :]
    criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 100, 1e-12)
    flat: Floats = np.asarray(cv2.undistortPoints(points, camera.matrix, camera.distortion, criteria=criteria)[:, 0], float)
    valid = _misses(camera, flat, pixels) < 0.1
    missed = np.flatnonzero(~valid & np.isfinite(pixels).all(axis=1))
    if len(missed):
        flat[missed] = _undistort_newton(camera, pixels[missed])
        valid[missed] = _misses(camera, flat[missed], pixels[missed]) < 0.1
    directions = np.column_stack([np.where(valid[:, None], flat, 0.0), np.ones(len(flat))])
    valid &= in_field(camera, directions)
    return directions / lengths(directions)[:, None], valid


def _misses(camera: Camera, flat: Floats, pixels: Floats) -> Floats:
    """Return the distances (N,), px, of pixels from projections of `flat` (N, 2) at z = 1. Non-finite points give inf."""
    import cv2

    homogeneous = np.column_stack([flat, np.ones(len(flat))])
    again = cv2.projectPoints(homogeneous, np.zeros(3), np.zeros(3), camera.matrix, camera.distortion)[0][:, 0]
    with np.errstate(invalid="ignore", over="ignore"):
        return np.where(np.isfinite(flat).all(axis=1), np.linalg.norm(again - pixels, axis=1), np.inf)


def _undistort_newton(camera: Camera, pixels: Floats) -> Floats:
    """Return the points (N, 2) at z = 1 that project to raw pixels (N, 2), by damped Newton steps.

    OpenCV's fixed-point iteration diverges far from the axis of a lens with a strong decentring or prism term.
    """
    import cv2

    flat = np.zeros_like(pixels)
    miss = _misses(camera, flat, pixels)
    factor = np.ones(len(pixels))
    for _ in range(_TURNS):
        homogeneous = np.column_stack([flat, np.ones(len(flat))])
        again, by = cv2.projectPoints(homogeneous, np.zeros(3), np.zeros(3), camera.matrix, camera.distortion)
        slope = by[:, 3:5].reshape(-1, 2, 2)  # The derivatives by the translation equal those by the point.
        step = (np.linalg.pinv(slope) @ (pixels - again[:, 0])[..., None])[..., 0]
        trial = flat + factor[:, None] * step
        closer = _misses(camera, trial, pixels)
        better = closer < miss
        flat, miss = np.where(better[:, None], trial, flat), np.where(better, closer, miss)
        factor = np.where(better, np.minimum(1.0, 2 * factor), factor / 2)
    return flat


def _undistort_fisheye(camera: Camera, pixels: Floats) -> tuple[Floats, Bools]:
    # cv2.fisheye.undistortPoints fails when the distorted angle is beyond 90 degrees, even if the angle itself is not.
    grows = _fisheye_radius(camera)
    slope = polyder(grows)
    flat = (pixels - camera.matrix[:2, 2]) / np.diag(camera.matrix)[:2]
    radius = np.hypot(flat[:, 0], flat[:, 1])
    valid = radius <= polyval(camera.lens_angle, grows)
    radius = np.where(valid, radius, 0.0)
    low, high = np.zeros(len(radius)), np.full(len(radius), camera.lens_angle)
    angle = np.minimum(radius, camera.lens_angle)
    for _ in range(_TURNS):
        over = polyval(angle, grows) - radius
        low, high = np.where(over > 0, low, angle), np.where(over > 0, angle, high)
        step = angle - over / np.maximum(polyval(angle, slope), _FLAT)
        step = np.where((step >= low) & (step <= high), step, (low + high) / 2)
        if (np.abs(step - angle) <= _EXACT).all():
            break
        angle = step
    across = np.where(valid[:, None], flat, 0.0) / np.maximum(radius, _FLAT)[:, None]
    return np.column_stack([np.sin(angle)[:, None] * across, np.cos(angle)]), np.asarray(valid)


def project(camera: Camera, points: Floats) -> Floats:
    """Return the raw (distorted) pixels (N, 2) of points (N, 3), m, in the camera frame and in front of the camera.

    A pixel has no meaning if its point is outside the lens field, which `in_field` tests.
    """
    if len(points) == 0:
        return np.zeros((0, 2))
    if not camera.fisheye and not camera.distortion.any():
        return np.asarray((points @ camera.matrix.T)[:, :2] / points[:, 2:])
    import cv2  # As in `undistort`.

    still = np.zeros(3)
    if camera.fisheye:
        pixels, _ = cv2.fisheye.projectPoints(points[:, None], still, still, camera.matrix, camera.distortion)
    else:
        pixels, _ = cv2.projectPoints(points, still, still, camera.matrix, camera.distortion)
    return np.asarray(pixels, dtype=np.float64).reshape(-1, 2)


def in_field(camera: Camera, points: Floats) -> Bools:
    """Return which points (N, 3), m, in the camera frame, are in front of the camera and inside its `lens_angle`."""
    x, y, z = points.T
    ahead: Bools = z > 0
    if camera.lens_angle < np.pi / 2:
        ahead &= x * x + y * y < math.tan(camera.lens_angle) ** 2 * z * z
    return ahead


def same_lens(one: Camera, other: Camera) -> bool:
    """Return whether two cameras have the same matrix, distortion and image size."""
    shape = one.distortion_model == other.distortion_model and (one.width, one.height) == (other.width, other.height)
    return shape and np.array_equal(one.matrix, other.matrix) and np.array_equal(one.distortion, other.distortion)


def in_view(camera: Camera, points: Floats, low: Floats | None = None, high: Floats | None = None) -> tuple[Ints, Floats]:
    """Return the indices (n,) and raw pixels (n, 2) of those points (N, 3) that the image shows.

    The points are in m, in the camera frame. The image shows a point if it is `in_field` and its pixel is between `low` and
    `high`. low, high: (2,) or (N, 2) px, the whole image by default.
    """
    low = np.zeros(2) if low is None else low
    high = camera.size - 1 if high is None else high
    ahead = in_field(camera, points).nonzero()[0]
    pixels = project(camera, points.take(ahead, axis=0))  # NumPy takes rows in a seventh of the time of an index.
    inside = pixels >= (low if low.ndim == 1 else low.take(ahead, axis=0))
    inside &= pixels <= (high if high.ndim == 1 else high.take(ahead, axis=0))
    shown = (inside[:, 0] & inside[:, 1]).nonzero()[0]
    return ahead.take(shown), pixels.take(shown, axis=0)


def depths(camera: Camera, points: Floats) -> Floats:
    """Return the depths (N,), m, of points (N, 3). The image size of an object is inversely proportional to its depth.

    The points are in m, in the camera frame. The depth is z, or for a fisheye lens the distance from the camera.
    """
    return np.asarray(np.linalg.norm(points, axis=1) if camera.fisheye else points[:, 2])


def _fisheye_radius(camera: Camera) -> Floats:
    """Return the polynomial (10,), lowest power first, that turns an angle (rad) into an image radius (focal lengths)."""
    radius = np.zeros(10)
    radius[1::2] = 1.0, *camera.distortion
    return radius


def _growth(camera: Camera, angle: Floats) -> Floats:
    """Return how fast (A,) the image radius grows at angles (A,), rad. Beyond the fold this is <= 0.

    For a fisheye lens, the growth is the derivative by the angle. For other lenses, it is the least derivative by tan(angle)
    over all image directions.
    """
    with np.errstate(all="ignore"):  # A wrong calibration may overflow.
        if camera.fisheye:
            return np.asarray(polyval(angle, polyder(_fisheye_radius(camera))))
        t, k = np.tan(angle), np.zeros(14)
        k[: len(camera.distortion)] = camera.distortion
        radius, divisor = np.zeros(8), np.zeros(7)
        radius[1::2] = 1.0, k[0], k[1], k[4]
        divisor[::2] = 1.0, *k[5:8]
        below = polyval(t, divisor)
        radial = (polyval(t, polyder(radius)) * below - polyval(t, radius) * polyval(t, polyder(divisor))) / below**2
        # Decentering and thin prisms reduce the radial growth by at most this amount in any direction.
        across = (6 * np.hypot(k[2], k[3]) + 2 * np.hypot(k[8], k[10])) * t + 4 * np.hypot(k[9], k[11]) * t**3
        return np.asarray(np.where(below > 0, radial - across, 0.0))


def box_sizes(box: Floats, direction: Floats, cameras: Sequence[Camera], camera: Ints) -> Floats:
    """Return the width and height (R, 2) of the object in each box (R, 4), px, in m per m of the object's distance.

    direction: (R, 3) unit vectors through the centres of the boxes, in the camera frame. camera: (R,) the index of each
    box's camera in `cameras`.
    """
    focal = np.array([[c.matrix[0, 0], c.matrix[1, 1]] for c in cameras])[camera]
    pinhole = np.array([not c.fisheye for c in cameras])[camera]
    depth = np.where(pinhole, direction[:, 2], 1.0)  # The size in a pinhole image falls with z, not with distance.
    # If the corners of a box are read in another order than they were written, a side may be negative.
    return np.asarray(np.maximum(box[:, 2:] - box[:, :2], 0.0) / focal * depth[:, None])


def _edge(low: float, right: float, bottom: float, pieces: int) -> Floats:
    """Return pixels (4 * pieces, 2) around the rectangle from corner (low, low) to (right, bottom)."""
    along = np.linspace(0.0, 1.0, pieces, endpoint=False)[:, None]
    corners = np.array([[low, low], [right, low], [right, bottom], [low, bottom]])
    return np.concatenate([a + along * (b - a) for a, b in zip(corners, np.roll(corners, -1, axis=0), strict=True)])
