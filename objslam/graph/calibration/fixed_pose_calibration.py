"""Estimate the errors that all measurements share at known poses, where the objects are the only other unknowns.

A Gauss-Newton step moves the errors and the objects together. Each object is eliminated by its own Schur complement.
`self_calibration` does the same in joint mode, where poses move too.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Self

import numpy as np

from objslam.core.arrays import Bools, Floats, Ints
from objslam.core.calibration import CalibratedMeasurements, Calibration, kind
from objslam.core.rotation import cross
from objslam.core.types import Association
from objslam.errors import SolveError

_ROUNDS = 12
"""The most Gauss-Newton steps. More steps are more exact, and a step is cheap."""
_CONVERGED = 0.01
"""An error has converged if its step is below this many posterior standard deviations. A larger number ends sooner."""
_CAUCHY = 3.0
"""The deviation, in standard deviations, at which a ray has half of its weight. A larger value gives outliers more
influence."""
_STRETCHES = 50
"""The number of stretches of the drive that count as independent. Fewer and longer stretches also show errors that are
correlated over a longer time, but the size of these errors is less exact then."""
_FREE = 1e-6
"""The information (m^-2) added to each object, so that an object without rays is determined too. A larger value moves other
objects."""

Noise = tuple[float, float]
"""The standard deviations of given poses: of headings, rad, and of places, m."""


@dataclass(frozen=True)
class FixedCalibration:
    """The shared errors at known poses. sensitivity: (N, 3, P) of the objects, m per unit of each error, 0 for an
    object without a position."""

    calibration: Calibration
    sensitivity: Floats


@dataclass(frozen=True)
class PointSystem:
    """The normal equations of the shared errors with the points eliminated. The robust weights are kept fixed.

    matrix: (P, P). vector: (P,) half the gradient of the cost. cost: the sum of the weighted squared deviations. variance:
    the factor (at least 1) by which the cost exceeds its expectation. curvature: 0 to 1, the mean curvature of Cauchy's loss
    divided by that of the weighted squares. scores: (n, P) the share of each ray in the vector. back: (N, 3, P) the
    derivative of the points by the errors. own: (N, 3) m, the step of the points with the errors kept fixed.
    """

    matrix: Floats
    vector: Floats
    cost: float
    variance: float
    curvature: float
    scores: Floats
    back: Floats
    own: Floats


def calibrate_at_poses(
    errors: CalibratedMeasurements,
    association: Association,
    positions: Floats,
    theta: Floats,
    noise: Noise,
    *,
    trusted: bool = True,
) -> FixedCalibration:
    """Estimate the shared errors, starting from theta (P,). An error that the rays do not determine stays at its prior.

    positions: (N, 3) m, the start, NaN for an object without a position, whose rays do not count. noise: of the poses.
    trusted: as in `linearise_points`. SolveError if the linear system has no single solution.
    """
    held = np.append(np.isfinite(positions[:, 0]), False)[association.object]  # Index -1 (no object) takes the last entry.
    number, owner = np.unique(association.object[held], return_inverse=True)
    points = positions[number]
    if not held.any():
        raise SolveError("no object has a position, so nothing can be calibrated against the poses")
    keyframe = errors.rays.keyframe[held]
    prior = np.asarray(np.linalg.inv(errors.prior), dtype=np.float64)
    for _ in range(_ROUNDS):
        system = linearise_points(errors, theta, points, owner, held, noise, trusted=trusted)
        worse = max(system.variance, _dependence(system, keyframe, prior) / system.curvature**2)
        try:
            covariance = np.asarray(np.linalg.inv(system.matrix / worse + prior), dtype=np.float64)
        except np.linalg.LinAlgError as error:
            raise SolveError(f"the calibration's linear system has no single solution: {error}") from error
        other = theta - covariance @ (system.vector / worse + prior @ (theta - errors.mean))
        other = np.clip(other, -errors.bounds, errors.bounds)
        step, theta = other - theta, other
        points = points + system.own + system.back @ step
        if (np.abs(step) < _CONVERGED * np.sqrt(np.diagonal(covariance))).all():
            break
    sensitivity = np.zeros((association.count, 3, len(theta)))
    sensitivity[number] = system.back
    found = Calibration(errors.names, theta, covariance, np.sqrt(np.diagonal(errors.prior)))
    return FixedCalibration(found, sensitivity)


def noise_of_errors(errors: CalibratedMeasurements, calibration: Calibration) -> Floats:
    """Return the standard deviations (R,), rad, of ray directions in map that follow from `calibration.covariance`."""
    size, axes = np.linalg.eigh(calibration.covariance)
    variance = np.zeros(len(errors.rays))
    for step in (axes * np.sqrt(np.maximum(size, 0.0))).T:
        variance += turned_by_errors(errors, calibration.values - step, calibration.values + step) ** 2 / 4
    return np.sqrt(variance)


def noise_beside_objects(
    errors: CalibratedMeasurements, found: FixedCalibration, association: Association, positions: Floats
) -> Floats:
    """Return the standard deviations (R,), rad, with which rays miss their objects because of the errors that are left.

    The objects move with the errors, as far as they can: if the camera is turned, all objects turn with it, and their rays
    still meet. So this is far less than `noise_of_errors` if an error only moves the map. A ray without an object gets the
    median of the other rays. positions: (N, 3) m at the calibrated errors, NaN for an object without a position.
    """
    values, owner = found.calibration.values, association.object
    held = np.append(np.isfinite(positions[:, 0]), False)[owner]  # Index -1 (no object) takes the last entry.
    if not held.any():
        return noise_of_errors(errors, found.calibration)

    def missed(step: Floats) -> Floats:
        keyframes, rays, _ = errors.at(values + step, drift=False)
        origins, directions = rays.in_map(keyframes.map_T_camera)
        to = (positions + found.sensitivity @ step)[owner[held]] - origins[held]
        return np.asarray(directions[held] - to / np.linalg.norm(to, axis=1, keepdims=True))

    size, axes = np.linalg.eigh(found.calibration.covariance)
    variance = np.zeros(int(held.sum()))
    for step in (axes * np.sqrt(np.maximum(size, 0.0))).T:
        variance += ((missed(step) - missed(-step)) ** 2).sum(axis=1) / 4
    every = np.full(len(held), float(np.median(variance)))
    every[held] = variance
    return np.sqrt(every)


def turned_by_errors(errors: CalibratedMeasurements, before: Floats, after: Floats) -> Floats:
    """Return the small angles (R,), rad, by which rays in map turn between two values (P,) of the shared errors."""
    ends = []
    for values in (before, after):
        keyframes, rays, _ = errors.at(values, drift=False)
        ends.append(rays.in_map(keyframes.map_T_camera)[1])
    return np.asarray(np.linalg.norm(ends[1] - ends[0], axis=1))


def linearise_points(
    errors: CalibratedMeasurements,
    theta: Floats,
    points: Floats,
    owner: Ints,
    held: Bools,
    noise: Noise,
    *,
    trusted: bool = True,
) -> PointSystem:
    """Return the normal equations at errors (P,) and points (N, 3).

    held: (R,) the rays that count. owner: (n,) the point of each ray that counts. noise: of the poses. trusted: whether the
    rays err as the noise says. If they err by far more, as at poses by odometry, their misses must not move points along
    the rays.
    """
    target = points[owner]

    def misses(values: Floats) -> _Misses:
        keyframes, rays, _ = errors.at(values, drift=False)
        origins, directions = rays.in_map(keyframes.map_T_camera)
        return _Misses.of(origins[held], directions[held], target, np.hypot(rays.sigma[held], noise[0]), noise[1])

    here = misses(theta)
    e, by_point = here.deviation, here.by_point(trusted)
    weight = 1 / (1 + (np.linalg.norm(e, axis=1) / _CAUCHY) ** 2)
    camera = errors.keyframes.camera[errors.rays.keyframe[held]]
    by_error = _slopes(lambda values: misses(values).deviation, errors, theta, camera)
    n, p = len(points), len(theta)
    h_pp, h_pt, g_p = np.zeros((n, 3, 3)), np.zeros((n, 3, p)), np.zeros((n, 3))
    weighted = weight[:, None, None] * by_point
    np.add.at(h_pp, owner, np.einsum("nki,nkj->nij", weighted, by_point))
    np.add.at(h_pt, owner, np.einsum("nki,nkp->nip", weighted, by_error))
    np.add.at(g_p, owner, np.einsum("nki,nk->ni", weighted, e))
    h_pp += _FREE * np.eye(3)
    back, own = -np.linalg.solve(h_pp, h_pt), -np.linalg.solve(h_pp, g_p[..., None])[..., 0]
    reduced = by_error + np.einsum("nki,nip->nkp", by_point, back[owner])
    left = e + np.einsum("nki,ni->nk", by_point, own[owner])
    scores = weight[:, None] * np.einsum("nkp,nk->np", reduced, e)
    matrix = np.einsum("n,nkp,nkq->pq", weight, reduced, reduced)
    cost = float((weight[:, None] * left**2).sum())
    variance = max(1.0, cost / max(2 * len(e) - 3 * n, 1))
    # For the weight w, the curvature is 2 w^2 - w along a deviation and w across it. The mean is w^2.
    curvature = float((weight**2).sum() / max(weight.sum(), 1e-300))
    return PointSystem(matrix, scores.sum(axis=0), cost, variance, curvature, scores, np.asarray(back), np.asarray(own))


def _dependence(system: PointSystem, keyframe: Ints, prior: Floats) -> float:
    """Return by which factor (at least 1) dependent errors of rays increase the variance of `system.vector`.

    Rays of one frame share the error of its pose. Rays of some seconds share the error of the localisation, or of the
    detector. The sums over stretches of the drive show this (cluster-robust covariance; Liang and Zeger 1986). The largest
    factor of all shared errors is used. prior: (P, P) information. An error is ignored if its prior has more information
    than the rays.
    """
    told = np.diagonal(system.matrix) > np.diagonal(prior)
    if not told.any():
        return 1.0
    stretch = keyframe * _STRETCHES // (int(keyframe.max()) + 1)
    sums = np.zeros((_STRETCHES, system.scores.shape[1]))
    np.add.at(sums, stretch, system.scores)
    return max(1.0, float(((sums**2).sum(axis=0)[told] / np.diagonal(system.matrix)[told]).max()))


def _slopes(residual: Callable[[Floats], Floats], errors: CalibratedMeasurements, theta: Floats, camera: Ints) -> Floats:
    """Return the derivatives (n, 2, P) of the residuals by the errors, as central differences.

    An error of a camera moves no ray of another camera. So the errors of one kind are moved at once for all cameras
    (Curtis, Powell and Reid 1974), and each ray shows the error of its own camera. camera: (n,) the camera of each ray.
    """
    owner = {f"{name}.{kind(one)}": i for one in errors.names for i, name in enumerate(errors.cameras)}
    together: dict[str, list[int]] = {}
    for k, name in enumerate(errors.names):
        together.setdefault(f"of each camera: {kind(name)}" if name in owner else name, []).append(k)
    slopes, steps = np.zeros((len(camera), 2, len(theta))), errors.steps
    for group in together.values():
        move = np.zeros(len(theta))
        move[group] = steps[group]
        change = residual(theta + move) - residual(theta - move)
        for k in group:
            number = owner.get(errors.names[k])
            mine = slice(None) if number is None else camera == number
            slopes[mine, :, k] = change[mine] / (2 * steps[k])
    return slopes


@dataclass(frozen=True)
class _Misses:
    """By how much n rays miss their points. The standard deviation of a miss depends on the distance.

    deviation: (n, 2) the angles between rays and points, in standard deviations, along the axes `basis` (n, 2, 3). to:
    (n, 3) the unit vectors to the points. distance: (n,) m. angle: (n,) rad, the noise of directions. sigma: (n,) rad, that
    of misses.
    """

    deviation: Floats
    basis: Floats
    to: Floats
    distance: Floats
    angle: Floats
    sigma: Floats

    @classmethod
    def of(cls, origins: Floats, directions: Floats, target: Floats, angle: Floats, place: float) -> Self:
        """Measure rays (n, 3) against points `target` (n, 3). place: m, the noise of origins."""
        to = target - origins
        distance = np.maximum(np.linalg.norm(to, axis=1), 1e-3)
        to = to / distance[:, None]
        level = np.stack([-directions[:, 1], directions[:, 0], np.zeros(len(directions))], axis=1)
        level /= np.maximum(np.linalg.norm(level, axis=1, keepdims=True), 1e-6)
        basis = np.stack([level, cross(directions, level)], axis=1)
        sigma = np.hypot(angle, place / distance)
        return cls(np.einsum("nki,ni->nk", basis, to) / sigma[:, None], basis, to, distance, angle, sigma)

    def by_point(self, trusted: bool) -> Floats:
        """Return the derivatives (n, 2, 3) of the deviations by the points.

        If the noise is trusted, they contain those of the standard deviation. Without them, the noise would bias the errors
        of the camera and the points, and more rays would not reduce this bias.
        """
        along = self.deviation * self.sigma[:, None] * (self.angle / self.sigma)[:, None] ** 2 * trusted
        across = self.basis - along[:, :, None] * self.to[:, None, :]
        return np.asarray(across / (self.distance * self.sigma)[:, None, None])
