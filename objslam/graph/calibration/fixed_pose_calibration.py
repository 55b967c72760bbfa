"""Estimate the errors that all measurements share, at known poses. The objects are the only other unknowns.

A Gauss-Newton step moves the errors and the objects together. Each object is eliminated by its own Schur complement.
`self_calibration` does the same in joint mode, where poses move too.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from itertools import pairwise
from typing import Self

import numpy as np

from objslam.core.arrays import Bools, Floats, Ints
from objslam.core.calibration import AXES, LENS, CalibratedMeasurements, Calibration, kind
from objslam.core.geometry import lengths
from objslam.core.rotation import cross
from objslam.core.types import Association
from objslam.errors import SolveError
from objslam.graph.calibration.prior_conflict import with_wider_priors

_ROUNDS = 12
"""The most Gauss-Newton steps. More steps are more exact, and a step is cheap."""
_CONVERGED = 0.01
"""The step of an error, in posterior standard deviations, below which the error has converged. A larger step ends sooner."""
_CAUCHY = 3.0
"""The deviation of a ray, in standard deviations, at which the ray has half of its full weight. A larger value gives
outliers more influence."""
_STRETCHES = 50
"""The number of stretches of the drive that count as independent. With fewer and longer stretches, errors that are
correlated over a longer time show too, but the size of such errors is less exact."""
_FREE = 1e-6
"""The information (m^-2) that is added to each object, so that even an object whose rays do not fix it is determined. A
larger value holds other objects back too."""

_RAYS_AT_ONCE = 200_000
"""The most rays that are computed together, counted once for each value of the errors. A larger number takes more memory."""

Noise = tuple[float, float]
"""The standard deviations of the headings (rad) and of the places (m) of given poses."""


@dataclass(frozen=True)
class FixedCalibration:
    """The shared errors at known poses.

    sensitivity: (N, 3, P) the derivatives of the objects by the errors, m per unit of each error, 0 for an object without a
    position.
    """

    calibration: Calibration
    sensitivity: Floats


@dataclass(frozen=True)
class PointSystem:
    """The normal equations of the shared errors with the points eliminated. The robust weights are kept fixed.

    matrix: (P, P) half the curvature of the cost. vector: (P,) half the gradient of the cost. cost: the sum of the weighted
    squared deviations. variance: the factor (at least 1) by which the cost exceeds its expectation. curvature: 0 to 1, the
    mean curvature of Cauchy's loss divided by the mean curvature of the weighted squares. scores: (n, P) the part of each
    ray in the vector. back: (N, 3, P) the derivatives of the points by the errors. own: (N, 3) m, the step of the points
    with the errors kept fixed.
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
    """Estimate the shared errors. The search starts at theta (P,).

    An error that the rays do not determine stays at its prior. positions: (N, 3) m, the objects at the start. An object
    without a position is NaN, and its rays do not count. noise: the noise of the poses. trusted: as in `linearise_points`.
    SolveError if the linear system has no single solution.
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
    return FixedCalibration(with_wider_priors(found, errors.mean, errors.prior), sensitivity)


def noise_of_errors(errors: CalibratedMeasurements, calibration: Calibration) -> Floats:
    """Return the standard deviations (R,), rad, of ray directions in map that follow from `calibration.covariance`."""
    steps, values = calibration.root.T, calibration.values
    variance = np.zeros(len(errors.rays))
    for some in _batches(len(steps), len(variance)):
        ends = errors.rays_in_map(values + np.concatenate([-steps[some], steps[some]]))[1]
        variance += ((ends[len(some) :] - ends[: len(some)]) ** 2).sum(axis=(0, 2)) / 4
    return np.sqrt(variance)


def noise_beside_objects(
    errors: CalibratedMeasurements, found: FixedCalibration, association: Association, positions: Floats
) -> Floats:
    """Return the standard deviations (R,), rad, with which rays miss their objects because the shared errors are uncertain.

    The objects move with the errors. If the camera is turned, all objects turn with it, and their rays still meet. So the
    result is far less than `noise_of_errors` if an error only moves the map. A ray without an object gets the median of all
    other rays. positions: (N, 3) m, at the calibrated errors, NaN for an object without a position.
    """
    values, owner = found.calibration.values, association.object
    held = np.append(np.isfinite(positions[:, 0]), False)[owner]  # Index -1 (no object) takes the last entry.
    if not held.any():
        return noise_of_errors(errors, found.calibration)

    def missed(steps: Floats) -> Floats:
        origins, directions, _ = errors.rays_in_map(values + steps)
        moved = positions + np.einsum("nip,mp->mni", found.sensitivity, steps)
        to = moved[:, owner[held]] - origins[:, held]
        return np.asarray(directions[:, held] - to / np.linalg.norm(to, axis=2, keepdims=True))

    steps = found.calibration.root.T
    variance = np.zeros(int(held.sum()))
    for some in _batches(len(steps), len(held)):
        variance += ((missed(steps[some]) - missed(-steps[some])) ** 2).sum(axis=(0, 2)) / 4
    every = np.full(len(held), float(np.median(variance)))
    every[held] = variance
    return np.sqrt(every)


def turned_by_errors(errors: CalibratedMeasurements, before: Floats, after: Floats) -> Floats:
    """Return the small angles (M, R), rad, between rays in map at M values `before` (M, P) of the shared errors, and the
    same rays at the value `after` (P,)."""
    _, directions, _ = errors.rays_in_map(np.concatenate([after[None], before]))
    return np.asarray(np.linalg.norm(directions[1:] - directions[0], axis=2))


def _batches(number: int, rays: int) -> list[Ints]:
    """Split the indices of steps into batches whose rays are computed together. rays: the number of rays of a step."""
    return np.array_split(np.arange(number), max(1, -(-number * rays // _RAYS_AT_ONCE)))


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

    held: (R,) a mask of the rays that count. owner: (n,) the point of each ray that counts. noise: the noise of the poses.
    trusted: whether the rays err as the noise says. If they err by far more, as at poses by odometry, their misses must not
    move points along the rays.
    """
    target = points[owner]

    def misses(values: Floats, of: CalibratedMeasurements = errors) -> _Misses:
        origins, directions, sigma = (part[:, held] for part in of.rays_in_map(values))
        return _Misses.of(origins, directions, target, sigma, noise)

    here = misses(theta[None])
    e, by_point = here.deviation[0], here.by_point(trusted)[0]
    weight = 1 / (1 + (np.linalg.norm(e, axis=1) / _CAUCHY) ** 2)
    camera = errors.keyframes.camera[errors.rays.keyframe[held]]
    expected = _with_directions(errors, theta, held, here.expected[0])
    by_error = _slopes(
        lambda values: misses(values).deviation, lambda values: misses(values, expected).deviation, errors, theta, camera
    )
    n, p = len(points), len(theta)
    # All rows of a point lie together, so that each sum over its rays is one product of matrices.
    order, root = np.argsort(owner, kind="stable"), np.sqrt(weight)[:, None, None]
    rows = (root * np.concatenate([by_point, by_error, e[..., None]], axis=2))[order].reshape(2 * len(owner), 3 + p + 1)
    ends = 2 * np.searchsorted(owner[order], np.arange(n + 1))
    own_rows = [rows[begin:end] for begin, end in pairwise(ends.tolist())]
    products = np.array([some[:, :3].T @ some for some in own_rows])
    moves = -np.linalg.solve(products[..., :3] + _FREE * np.eye(3), products[..., 3:])
    left = np.concatenate([some[:, 3:] + some[:, :3] @ move for some, move in zip(own_rows, moves, strict=True)])
    scores = np.empty((len(owner), p))
    scores[order] = (left[:, :p] * rows[:, -1:]).reshape(-1, 2, p).sum(axis=1)
    matrix, cost = left[:, :p].T @ left[:, :p], float(left[:, p] @ left[:, p])
    variance = max(1.0, cost / max(2 * len(e) - 3 * n, 1))
    # Cauchy's loss with the weight w has the curvature 2 w^2 - w along a deviation and w across it. The mean is w^2.
    curvature = float((weight**2).sum() / max(weight.sum(), 1e-300))
    return PointSystem(matrix, scores.sum(axis=0), cost, variance, curvature, scores, moves[..., :p], moves[..., p])


def _dependence(system: PointSystem, keyframe: Ints, prior: Floats) -> float:
    """Return by which factor (at least 1) dependent errors of rays increase the variance of `system.vector`.

    Rays of one frame share the error of its pose. Rays of some seconds share the error of the localisation, or of the
    detector. Sums over stretches of the drive show this dependence (cluster-robust covariance; Liang and Zeger 1986). The
    result is the largest factor of all shared errors. An error is ignored if its prior has more information than the rays.
    keyframe: (n,) the keyframe of each ray. prior: (P, P) information.
    """
    told = np.diagonal(system.matrix) > np.diagonal(prior)
    if not told.any():
        return 1.0
    stretch = keyframe * _STRETCHES // (int(keyframe.max()) + 1)
    sums = np.zeros((_STRETCHES, system.scores.shape[1]))
    np.add.at(sums, stretch, system.scores)
    return max(1.0, float(((sums**2).sum(axis=0)[told] / np.diagonal(system.matrix)[told]).max()))


def _with_directions(
    errors: CalibratedMeasurements, theta: Floats, held: Bools, map_direction: Floats
) -> CalibratedMeasurements:
    """Return the measurements, changed so that the rays `held` (R,) have unit directions (n, 3) in map at errors (P,)."""
    rays, direction = errors.rays, errors.rays.direction.copy()
    keyframes, corrected, _ = errors.at(theta, drift=False)
    turns = keyframes.map_T_camera[rays.keyframe[held], :3, :3]
    direction[held] = np.einsum("rji,rj->ri", turns, map_direction)
    return errors.with_rays(direction, corrected.range, theta)


def _slopes(
    measured: Callable[[Floats], Floats],
    expected: Callable[[Floats], Floats],
    errors: CalibratedMeasurements,
    theta: Floats,
    camera: Ints,
) -> Floats:
    """Return the derivatives (n, 2, P) of the residuals by the errors, as central differences.

    An error of a camera moves no ray of another camera. So the errors of one kind are moved at once for all cameras (Curtis,
    Powell and Reid 1974), and each ray shows the error of its own camera.

    How much a lens or a rotation of the camera turns a ray depends on where the ray lies in the image. At the measured rays,
    such derivatives would contain the noise of the residuals, and their product with the residuals would bias the errors
    (errors in variables; Fuller 1987). So the derivatives by lenses and rotations are taken at the expected rays.

    measured, expected: functions that return the residuals (M, n, 2) at M values (M, P), of the rays as measured and as
    expected. camera: (n,) the camera of each ray.
    """
    groups, owner = _moved_together(errors.names, errors.cameras)
    slopes = np.zeros((len(camera), 2, len(theta)))
    turns = np.array([kind(errors.names[group[0]]) in (*LENS, *AXES) for group in groups], dtype=bool)
    for some, residuals in ((np.flatnonzero(~turns), measured), (np.flatnonzero(turns), expected)):
        for batch in _batches(len(some), len(errors.rays)) if len(some) else ():
            moved = [groups[number] for number in some[batch].tolist()]
            moves = np.array([np.isin(np.arange(len(theta)), group) for group in moved]) * errors.steps
            ends = residuals(theta + np.concatenate([moves, -moves]))
            for group, change in zip(moved, ends[: len(moved)] - ends[len(moved) :], strict=True):
                for k in group:
                    mine = slice(None) if owner[k] is None else camera == owner[k]
                    slopes[mine, :, k] = change[mine] / (2 * errors.steps[k])
    return slopes


@lru_cache(maxsize=16)
def _moved_together(
    names: tuple[str, ...], cameras: tuple[str, ...]
) -> tuple[tuple[tuple[int, ...], ...], tuple[int | None, ...]]:
    """Return groups of errors, as indices, and the camera of each error. No two errors of a group move the same ray.

    The camera is None for an error that belongs to no camera.
    """
    owner = [cameras.index(name.rpartition(".")[0]) if name.rpartition(".")[0] in cameras else None for name in names]
    together: dict[str, list[int]] = {}
    for k, name in enumerate(names):
        together.setdefault(name if owner[k] is None else f"of each camera: {kind(name)}", []).append(k)
    return tuple(tuple(group) for group in together.values()), tuple(owner)


@dataclass(frozen=True)
class _Misses:
    """The angles by which n rays miss their points. The standard deviation of a miss depends on the distance of the point.

    All arrays have a first axis for M values of the errors. deviation: (M, n, 2) the angles between rays and points, in
    standard deviations, along the axes `basis` (M, n, 2, 3). to: (M, n, 3) the unit vectors to the points. distance: (M, n)
    m, to the points. box: (M, n) rad, the noise of the box. angle: (M, n) rad, the noise of box and heading together. sigma:
    (M, n) rad, the noise of misses, with the noise of the place of the pose.
    """

    deviation: Floats
    basis: Floats
    to: Floats
    distance: Floats
    box: Floats
    angle: Floats
    sigma: Floats

    @classmethod
    def of(cls, origins: Floats, directions: Floats, target: Floats, box: Floats, noise: Noise) -> Self:
        """Compare rays (M, n, 3) with points `target` (n, 3), m. box: (M, n) rad. noise: the noise of the poses."""
        to = target - origins
        distance = np.maximum(lengths(to), 1e-3)
        to = to / distance[..., None]
        level = np.stack([-directions[..., 1], directions[..., 0], np.zeros(distance.shape)], axis=-1)
        level /= np.maximum(lengths(level), 1e-6)[..., None]
        basis = np.stack([level, cross(directions, level)], axis=-2)
        angle = np.hypot(box, noise[0])
        sigma = np.hypot(angle, noise[1] / distance)
        return cls(np.einsum("mnki,mni->mnk", basis, to) / sigma[..., None], basis, to, distance, box, angle, sigma)

    @property
    def expected(self) -> Floats:
        """(M, n, 3) the expected unit directions of the rays, without the noise of their boxes.

        A ray is turned towards its point by the share of its miss that the noise of the box explains. The noise of poses
        explains the rest, and does not move a ray in its image.
        """
        turned = self.deviation * self.sigma[..., None] * (self.box / self.sigma)[..., None] ** 2
        direction = cross(self.basis[..., 0, :], self.basis[..., 1, :]) + np.einsum("mnk,mnki->mni", turned, self.basis)
        return np.asarray(direction / lengths(direction)[..., None])

    def by_point(self, trusted: bool) -> Floats:
        """Return the derivatives (M, n, 2, 3) of the deviations by the points.

        If the noise is trusted, they contain the change of the standard deviation with the distance. Without this part, the
        noise would bias the errors of the camera and the points, and more rays would not reduce this bias.
        """
        along = self.deviation * self.sigma[..., None] * (self.angle / self.sigma)[..., None] ** 2 * trusted
        across = self.basis - along[..., None] * self.to[..., None, :]
        return np.asarray(across / (self.distance * self.sigma)[..., None, None])
