"""A calibrated camera: which pixel shows which direction, and what lies in its image at all."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from functools import cached_property
from typing import Literal

import numpy as np
from numpy.polynomial.polynomial import polyder, polyval

from objslam.core.arrays import Bools, Floats, Ints

DistortionModel = Literal["plumb_bob", "rational_polynomial", "equidistant"]

COEFFICIENTS: dict[DistortionModel, tuple[int, ...]] = {
    "plumb_bob": (4, 5),
    "rational_polynomial": (8, 12, 14),
    "equidistant": (4,),
}
"""How many distortion coefficients each model takes."""

_STEPS, _FINER = 2000, 4  # angles tried to find where a lens model folds back, and how often the steps become finer
_ALONG = 200  # pieces of each side of the image
_LEAST = 1e-9  # sr; no camera sees less
_TURNS, _EXACT, _FLAT = 60, 1e-14, 1e-12  # iterations at the most, rad, and the least divisor


@dataclass(frozen=True)
class Camera:
    """A calibrated camera (ROS camera_info keys) and its place on the robot.

    matrix: (3, 3) px. distortion: (D,). base_T_camera: (4, 4), the optical frame in base. depth_scale: units per metre.
    sees_size: whether its boxes are as large as what they hold, and not drawn around bearings, which have no size.
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
        """(3, 3), from homogeneous pixels to directions with z = 1."""
        return np.asarray(np.linalg.inv(self.matrix), dtype=np.float64)

    @cached_property
    def fisheye(self) -> bool:
        """Whether its image grows with the angle off the axis, and not with the tangent of it."""
        return self.distortion_model == "equidistant"

    @cached_property
    def lens_angle(self) -> float:
        """How far off the optical axis the lens model holds, rad: up to where it folds back, 90 degrees at the most.

        Further out, the model projects into the image what is out of sight. A fisheye may see beyond 90 degrees, but its
        calibration does not say so: OpenCV fits the polynomial to points with z > 0 alone, and nothing tells how much of the
        image's corners the lens fills.
        """
        return _fold(self)

    @cached_property
    def view_angle(self) -> float:
        """The angle off the optical axis of the furthest point of the image's edge, rad; never more than `lens_angle`."""
        directions, valid = undistort(self, _edge(0.0, self.width - 1, self.height - 1, 32))
        return float(np.arccos(np.clip(directions[:, 2], -1.0, 1.0)).max()) if valid.all() else self.lens_angle

    @cached_property
    def solid_angle(self) -> float:
        """What its image shows, sr."""
        return _solid_angle(self)


def undistort(camera: Camera, pixels: Floats) -> tuple[Floats, Bools]:
    """Unit directions (N, 3) in the camera frame of raw pixels (N, 2), and which of them (N,) lie in the lens' field.

    plumb_bob and rational_polynomial by cv2.undistortPoints, iterated to the end; a pixel that does not come back to itself
    within 0.1 px has no ray either. equidistant (Kannala-Brandt) by Newton's method.
    """
    import cv2

    if len(pixels) == 0:
        return np.zeros((0, 3)), np.zeros(0, dtype=bool)
    if camera.fisheye:
        return _undistort_fisheye(camera, pixels)
    if not camera.distortion.any():
        finite: Bools = np.asarray(np.isfinite(pixels).all(axis=1))
        pixels = pixels if finite.all() else np.where(finite[:, None], pixels, 0.0)
        straight = pixels @ camera.inverse_matrix[:, :2].T + camera.inverse_matrix[:, 2]
        return straight / np.linalg.norm(straight, axis=1, keepdims=True), finite
    points = np.ascontiguousarray(pixels, dtype=np.float64)[:, None, :]
    criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 100, 1e-12)
    flat = cv2.undistortPoints(points, camera.matrix, camera.distortion, criteria=criteria)[:, 0]
    homogeneous = np.column_stack([flat, np.ones(len(flat))])
    again = cv2.projectPoints(homogeneous, np.zeros(3), np.zeros(3), camera.matrix, camera.distortion)[0][:, 0]
    with np.errstate(invalid="ignore", over="ignore"):
        valid = np.isfinite(flat).all(axis=1) & (np.linalg.norm(again - pixels, axis=1) < 0.1)
    directions = np.column_stack([np.where(valid[:, None], flat, 0.0), np.ones(len(flat))])
    valid &= in_field(camera, directions)
    return directions / np.linalg.norm(directions, axis=1, keepdims=True), valid


def _undistort_fisheye(camera: Camera, pixels: Floats) -> tuple[Floats, Bools]:
    # cv2.fisheye.undistortPoints gives up where the distorted angle, not the angle itself, is beyond 90 degrees
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
    """Raw (distorted) pixels (N, 2) of points (N, 3), m, in the camera frame, in front of the camera.

    Outside the lens' field they mean nothing: see `in_field`.
    """
    import cv2

    if len(points) == 0:
        return np.zeros((0, 2))
    still = np.zeros(3)
    if camera.fisheye:
        pixels, _ = cv2.fisheye.projectPoints(points[:, None], still, still, camera.matrix, camera.distortion)
    elif camera.distortion.any():
        pixels, _ = cv2.projectPoints(points, still, still, camera.matrix, camera.distortion)
    else:
        pixels = (points @ camera.matrix.T)[:, :2] / points[:, 2:]
    return np.asarray(pixels, dtype=np.float64).reshape(-1, 2)


def in_field(camera: Camera, points: Floats) -> Bools:
    """Which points (N, 3), m, in the camera frame lie in front of the camera, where its lens model holds."""
    x, y, z = points.T
    ahead: Bools = z > 0
    if camera.lens_angle < np.pi / 2:
        ahead &= x * x + y * y < math.tan(camera.lens_angle) ** 2 * z * z
    return ahead


def in_view(camera: Camera, points: Floats, low: Floats | None = None, high: Floats | None = None) -> tuple[Ints, Floats]:
    """Which points (N, 3), m, in the camera frame its image shows, indices (n,), and their raw pixels (n, 2).

    A point is shown that lies in the lens' field and whose pixel lies between low and high, (2,) or (N, 2), px: without
    them, in the image.
    """
    low = np.zeros(2) if low is None else low
    high = camera.size - 1 if high is None else high
    ahead = in_field(camera, points).nonzero()[0]
    pixels = project(camera, points[ahead])
    inside = pixels >= (low if low.ndim == 1 else low[ahead])
    inside &= pixels <= (high if high.ndim == 1 else high[ahead])
    shown = inside[:, 0] & inside[:, 1]
    return ahead[shown], pixels[shown]


def depths(camera: Camera, points: Floats) -> Floats:
    """By what (N,), m, the image of things at points (N, 3) in the camera frame is smaller: z, or a fisheye's distance."""
    return np.asarray(np.linalg.norm(points, axis=1) if camera.fisheye else points[:, 2])


def _fisheye_radius(camera: Camera) -> Floats:
    """The coefficients (10,) of a fisheye's radius as a polynomial of the angle off the axis (rad), lowest power first.

    The radius is the distance from the principal point in the image, in focal lengths.
    """
    radius = np.zeros(10)
    radius[1::2] = 1.0, *camera.distortion
    return radius


def _growth(camera: Camera, angle: Floats) -> Floats:
    """How fast (A,) the image's radius grows at angles off the axis (A,), rad, with the angle or its tangent t.

    It is zero or less where the lens model has folded back.
    """
    with np.errstate(all="ignore"):  # a calibration may be nonsense
        return _fisheye_growth(camera, angle) if camera.fisheye else _pinhole_growth(camera, np.tan(angle))


def _fisheye_growth(camera: Camera, angle: Floats) -> Floats:
    return np.asarray(polyval(angle, polyder(_fisheye_radius(camera))))


def _pinhole_growth(camera: Camera, t: Floats) -> Floats:
    k = np.zeros(14)
    k[: len(camera.distortion)] = camera.distortion
    radius, divisor = np.zeros(8), np.zeros(7)
    radius[1::2] = 1.0, k[0], k[1], k[4]
    divisor[::2] = 1.0, *k[5:8]
    below = polyval(t, divisor)
    radial = (polyval(t, polyder(radius)) * below - polyval(t, radius) * polyval(t, polyder(divisor))) / below**2
    # the most that decentering, and then a thin prism, can take from it in any direction
    across = (6 * np.hypot(k[2], k[3]) + 2 * np.hypot(k[8], k[10])) * t + 4 * np.hypot(k[9], k[11]) * t**3
    return np.asarray(np.where(below > 0, radial - across, 0.0))


def _fold(camera: Camera) -> float:
    """The first angle, rad, at which the image's radius no longer grows; 90 degrees where there is none below."""
    if not camera.distortion.any():
        return np.pi / 2
    angle = np.linspace(0.0, np.pi / 2, _STEPS, endpoint=False)
    for _ in range(_FINER):
        grows = _growth(camera, angle) > 0
        if grows.all():
            return np.pi / 2
        first = int(np.argmin(grows))
        angle = np.linspace(angle[first - 1], angle[first], _STEPS)
    return float(angle[0])


def _edge(low: float, right: float, bottom: float, pieces: int) -> Floats:
    """Pixels (4 * pieces, 2) along the edge of the image, once around, from the corner (low, low)."""
    along = np.linspace(0.0, 1.0, pieces, endpoint=False)[:, None]
    corners = np.array([[low, low], [right, low], [right, bottom], [low, bottom]])
    return np.concatenate([a + along * (b - a) for a, b in zip(corners, np.roll(corners, -1, axis=0), strict=True)])


def _solid_angle(camera: Camera) -> float:
    """The sum of the spherical triangles between the optical axis and the pieces of the image's edge.

    A piece outside the lens' field counts as the sector of the cone that the field is.
    """
    edge = _edge(-0.5, camera.width - 0.5, camera.height - 0.5, _ALONG)
    here, valid = undistort(camera, edge)
    flat = edge - camera.matrix[:2, 2]
    around = np.arctan2(flat[:, 1] / camera.matrix[1, 1], flat[:, 0] / camera.matrix[0, 0])
    sin, cos = np.sin(camera.lens_angle), np.cos(camera.lens_angle)
    rim = np.column_stack([sin * np.cos(around), sin * np.sin(around), np.full(len(edge), cos)])
    here = np.where(valid[:, None], here, rim)
    then = np.roll(here, -1, axis=0)
    turned = (np.roll(around, -1) - around + np.pi) % (2 * np.pi) - np.pi
    volume = here[:, 0] * then[:, 1] - here[:, 1] * then[:, 0]
    triangles = 2 * np.arctan2(volume, 1 + here[:, 2] + then[:, 2] + (here * then).sum(axis=1))
    outside = ~valid & ~np.roll(valid, -1)
    return max(abs(float(np.where(outside, turned * (1 - cos), triangles).sum())), _LEAST)
