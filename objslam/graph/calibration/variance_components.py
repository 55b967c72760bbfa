"""Estimate the noise of a log's measurements from its residuals, by iterated variance components (Koch 1999, 3.6).

Each kind of noise gets the size for which the squares of its whitened residuals sum up to their redundancy. The redundancy
is the part of the residuals that poses, landmarks and shared errors do not absorb. Random probes measure it (Hutchinson
1990).
"""

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Self

import numpy as np
from scipy import sparse

from objslam.core.arrays import Floats, Ints
from objslam.core.calibration import CalibratedMeasurements
from objslam.core.geometry import adjoint, inverse
from objslam.core.noise import MOST_NOISE, LabelNoise, NoiseFactors
from objslam.core.statistics import HUBER_K
from objslam.graph.calibration.linearised_graph import Linearised
from objslam.graph.calibration.range_noise import RangeNoise
from objslam.graph.calibration.shared_error_jacobian import LinearSystem
from objslam.graph.calibration.shrinkage import shrinking_force
from objslam.graph.factors.bearing import tangent_basis
from objslam.graph.factors.odometry_motions import OdometryMotions
from objslam.graph.factors.residual_algebra import whitening
from objslam.graph.least_squares.anderson import MEMORY, accelerated
from objslam.graph.least_squares.chain import ChainRows
from objslam.graph.least_squares.normal_equations import Equations, factored

_PROBES, _FEWEST_PROBES = 12, 4
"""The most and the fewest random probes. With n independent residuals, the relative error of the redundancy is
sqrt(2 / (n * probes)). More probes are slower."""
_PRODUCTS = 3000
"""The number of probes, times the number of independent residuals, that is enough. With 3000, the redundancy has a standard
deviation of 3 %, and a factor has half of that. So a long log needs fewer probes than `_PROBES`. A larger number is more
exact and slower."""
_ITERATIONS = 20
"""The most iterations. Each iteration factorises the linear system, so more are slower. The MRCLAM robots take 5 to 12."""
_CONVERGED = 0.01
"""The relative change of all factors below which the iteration ends. A factor that the log hardly determines changes slowly.
With a larger value, the iteration ends before such a factor has its value. With 0.02, one MRCLAM robot without ranges got
2.2 instead of 2.8."""
_LIMITS = (0.05, MOST_NOISE)
"""The smallest and the largest factor on a nominal noise. Beyond them, the settings do not describe the sensor at all."""
_SHORTEST, _LONGEST = 3.0, 6.0
"""The bounds of `correlation_time`, s. Wheels lag behind a command, and a detector's box is off, for one or two seconds.
Slip lasts as long as the ground and the load stay the same. The speeds of five robots (MRCLAM, against motion capture) had
errors with a correlation of 0.5 after 2 s, 1/e after 4 s and 0.3 after 6 s. Longer times show slower errors, from fewer
sums."""
_WINDOWS = 30
"""The number of windows into which `correlation_time` divides a log, within its bounds. The variance of 30 sums is known to
26 %. A larger number shortens the windows."""
_MOST_SHRINKAGE = 0.3
"""The largest shrinkage that is corrected, as a share of the size. A larger shrinkage has another cause, which a larger
limit would hide."""
_KINDS = ("rays", "ranges", "range_bias", "along", "across", "turning")
"""The names of the factors that the iteration estimates. They are fields of `NoiseFactors`."""
_MEAN_NORMAL = np.sqrt(np.pi / 2)
"""The factor from the mean absolute value of Gaussian numbers to their standard deviation."""


@dataclass(frozen=True)
class _Rows:
    """A description of the rows of a linear system: n bearings, q ranges and s motions, with their nominal noise.

    bearing_axes: (n, 2, 2) turn the two rows of a bearing into azimuth and elevation. bearing_weight: (n,) robust weights.
    ranges: the noise of the ranges. label_names: (L,). motions: the motions in the graph. parts: (3, s, 6, 6) covariances of
    the motions by the noise along, across and in turning. rest: (s, 6, 6) covariances by the noise of `planar`. motion_axes:
    (3, s, 6) twists along, across and in turning, in the camera frame after the motion. motion_window: (s,) the window of
    each motion. ray_window: (n,) the window of each ray. The errors in a window may be correlated.
    """

    bearing_axes: Floats
    bearing_weight: Floats
    ranges: RangeNoise
    label_names: tuple[str, ...]
    motions: OdometryMotions | None
    parts: Floats
    rest: Floats
    motion_axes: Floats
    motion_window: Ints
    ray_window: Ints

    @cached_property
    def by_motion_window(self) -> sparse.csr_matrix:
        """The matrix (W, s) that sums the values of motions in each window."""
        return _sums_in(self.motion_window)

    @cached_property
    def by_ray_window(self) -> sparse.csr_matrix:
        """The matrix (W, n) that sums the values of rays in each window."""
        return _sums_in(self.ray_window)

    @property
    def probes(self) -> int:
        """The number of random probes: enough for the kind of noise with the fewest independent residuals."""
        fewest = min((int(window.max()) + 1 for window in (self.motion_window, self.ray_window) if len(window)), default=1)
        return int(np.clip(-(-_PRODUCTS // fewest), _FEWEST_PROBES, _PROBES))


def estimate_noise(
    of: Linearised, system: LinearSystem, errors: CalibratedMeasurements, theta: Floats, prior_residuals: float
) -> NoiseFactors:
    """Return the noise that agrees best with the residuals of a solved graph, as factors on the nominal noise.

    Kinds of noise that are known keep their factor. system: the linear system of the graph, with the noise `errors.noise`,
    at the shared errors theta (P,). prior_residuals: the weight of the nominal noise of each kind, as a number of residuals.
    """
    kinds, rows = errors.unknown_noise, _rows(of, errors, theta)
    if not kinds - {"localization"}:
        return errors.noise
    root = np.linalg.cholesky(np.linalg.inv(errors.prior)).T
    jacobian, residual = system.jacobian, np.append(system.residual, root @ (theta - errors.mean))
    probes = np.random.default_rng(0).choice([-1.0, 1.0], (len(residual), rows.probes))
    begin = noise = errors.noise
    history = list[tuple[Floats, Floats]]()
    whitens = whitening(_motion_covariance(rows, noise))
    rescaling = _Rescaling.of(system, rows, begin, whitens)
    left = _left(jacobian, system.normal, system.sides, root, np.column_stack([probes, residual]))
    for _ in range(_ITERATIONS):
        other = _updated(system, rows, noise, whitens, kinds, probes, left, prior_residuals)
        if other.like(noise, _CONVERGED):
            noise = other
            break
        history = [*history[-MEMORY:], (_logarithms(noise), _logarithms(other) - _logarithms(noise))]
        noise = _from_logarithms(accelerated(history, 1.0), other)
        whitens = whitening(_motion_covariance(rows, noise))
        rescale, chain = rescaling.to(noise, whitens)
        told = np.column_stack([probes, np.append(rescale @ system.residual, residual[len(system.residual) :])])
        scaled = rescale @ jacobian
        normal = factored(scaled, chain, of.graph.blocks, of.order)
        left = _left(scaled, normal, rescale @ system.sides, root, told)
    force, curvature = shrinking_force(of)
    return replace(noise, shrinkage=min(force / curvature, _MOST_SHRINKAGE))


def correlation_time(stamps: Floats) -> float:
    """Return the length, s, of the windows in which errors may be correlated, for a log with these stamps (K,), s."""
    duration = float(np.ptp(stamps)) if len(stamps) else 0.0
    return float(np.clip(duration / _WINDOWS, _SHORTEST, _LONGEST))


def _logarithms(noise: NoiseFactors) -> Floats:
    """Return the logarithms of the factors on noise. The iteration is close to linear in them."""
    return np.log([getattr(noise, name) for name in _KINDS])


def _from_logarithms(logarithms: Floats, other: NoiseFactors) -> NoiseFactors:
    """Return the noise `other` with these logarithms of its factors, within `_LIMITS`."""
    factors = np.clip(np.exp(logarithms), *_LIMITS)
    return replace(other, **dict(zip(_KINDS, factors.tolist(), strict=True)))


def _rows(of: Linearised, errors: CalibratedMeasurements, theta: Floats) -> _Rows:
    keyframes, rays = of.measured.keyframes, of.measured.rays.take(of.which)
    motions, (_, after) = of.measured.motions, of.graph.moves
    parts = [np.zeros((0, 6, 6))] * 4
    if motions is not None and len(motions):
        kinds = errors.drift_components(theta)
        parts = [motions.noise_of(of.measured.multiframes.keyframes(one), settings) for one, settings in kinds]
    origins, directions = rays.in_map(of.map_T_camera)
    to_landmark = of.positions[of.association.object[of.which]] - origins
    off = np.linalg.norm(np.cross(directions, to_landmark), axis=1) / np.linalg.norm(to_landmark, axis=1)
    stamps = np.maximum.accumulate(keyframes.stamps)
    second = np.floor(stamps / correlation_time(stamps)).astype(np.int64)
    owner = of.association.object[of.which]
    if of.measured.tags is not None:  # The corners of a fiducial may err together.
        owner = of.measured.tags.object_of_landmark()[owner]
    pair = np.column_stack([owner, second[rays.keyframe]])
    to_camera = adjoint(inverse(keyframes.base_T_camera[after]))
    return _Rows(
        bearing_axes=_azimuth_elevation(rays.direction, keyframes.base_T_camera[rays.keyframe]),
        bearing_weight=np.minimum(1.0, HUBER_K * rays.sigma / np.maximum(off, 1e-12)),
        ranges=_range_rows(of, errors),
        label_names=tuple(errors.rays.label_names),
        motions=motions,
        parts=np.array(parts[:3]),
        rest=parts[3],
        motion_axes=np.moveaxis(to_camera[:, :, [3, 4, 2]], 2, 0),
        motion_window=np.unique(second[after], return_inverse=True)[1],
        ray_window=np.unique(pair, axis=0, return_inverse=True)[1].ravel(),
    )


def _left(jacobian: sparse.csr_matrix, normal: Equations, sides: Floats, prior: Floats, told: Floats) -> Floats:
    """Return the residuals of columns `told` (M + P, n) after a least-squares fit by all variables and shared errors.

    jacobian: (M, D) the derivatives by poses and landmarks. normal: the normal equations of the Jacobian. sides: (M, P) the
    derivatives by the shared errors. prior: (P, P) the derivatives of the last P rows by the shared errors. The sides are
    dense, so a Schur complement eliminates the shared errors last. As columns of the sparse matrix, the sides would make its
    factorisation four times as slow.
    """
    both = np.hstack([sides, told[: len(sides)]])
    both = both - jacobian @ normal.solve(jacobian.T @ both)
    reduced = np.vstack([both[:, : sides.shape[1]], prior])
    rest = np.vstack([both[:, sides.shape[1] :], told[len(sides) :]])
    return np.asarray(rest - reduced @ np.linalg.solve(reduced.T @ reduced, reduced.T @ rest))


@dataclass(frozen=True)
class _Rescaling:
    """A change of the noise that whitens M rows, from the noise `begin` to another noise.

    system, rows: the rows. colours: (s, 6, 6) matrices that undo the whitening of the motions. pattern: the columns of the
    entries, row by row, and the first entry of each row, in the sparse matrix (M, M) of the change.
    """

    system: LinearSystem
    rows: _Rows
    begin: NoiseFactors
    colours: Floats
    pattern: tuple[Ints, Ints]

    @classmethod
    def of(cls, system: LinearSystem, rows: _Rows, begin: NoiseFactors, whitens: Floats) -> Self:
        """Prepare the change. whitens: (s, 6, 6) matrices that whiten the motions, for the noise `begin`."""
        size, first = len(system.residual), system.first_motion
        last = first + whitens.size // 6
        blocks = np.repeat(np.arange(first, last).reshape(-1, 6), 6, axis=0)
        columns = np.concatenate([np.arange(first), blocks.ravel(), np.arange(last, size)])
        lengths = np.ones(size, dtype=np.int64)
        lengths[first:last] = 6
        return cls(system, rows, begin, np.asarray(np.linalg.inv(whitens)), (columns, np.append(0, np.cumsum(lengths))))

    def to(self, noise: NoiseFactors, whitens: Floats) -> tuple[sparse.csr_matrix, ChainRows | None]:
        """Return the matrix (M, M) that changes the rows to the given noise, and the rows of the chain for the given noise.

        The second value is None if the system has no chain. whitens: (s, 6, 6) matrices that whiten the motions, for the
        given noise.
        """
        system, rows, size = self.system, self.rows, len(self.system.residual)
        scale = np.ones(size)
        scale[: system.first_range] = self.begin.rays / noise.rays
        ranges = slice(system.first_range, system.first_range + len(rows.ranges.owner))
        scale[ranges] = _range_sigma(rows, self.begin) / _range_sigma(rows, noise)
        last = system.first_motion + whitens.size // 6
        moves = whitens @ self.colours
        data = np.concatenate([scale[: system.first_motion], moves.ravel(), scale[last:]])
        chain = None if system.chain is None else system.chain.rescaled(self.begin.rays / noise.rays, scale[ranges], moves)
        return sparse.csr_matrix((data, *self.pattern), shape=(size, size)), chain


def _updated(
    system: LinearSystem,
    rows: _Rows,
    noise: NoiseFactors,
    whitens: Floats,
    kinds: frozenset[str],
    probes: Floats,
    left: Floats,
    prior: float,
) -> NoiseFactors:
    """Return the noise after one step of the iteration.

    whitens: (s, 6, 6) matrices that whiten the motions, for the present noise. kinds: the kinds of noise to estimate. left:
    (M + P, probes + 1) what a least-squares fit leaves of the probes and the residuals. prior: the weight of the nominal
    noise, as a number of residuals.
    """
    found: dict[str, Any] = noise.to_dict(None)
    residual, kept, count = left[:, -1], left[:, :-1], probes.shape[1]
    if "rays" in kinds and len(rows.bearing_weight):
        found["rays"] = _ray_noise(rows, noise.rays, residual, probes, kept, prior)
    if "ranges" in kinds and len(rows.ranges.owner):
        off = residual[system.first_range : system.first_range + len(rows.ranges.owner)] * _range_sigma(rows, noise)
        found["ranges"], found["range_bias"], factors = rows.ranges.estimate(off, len(rows.label_names), prior)
        ranged = np.flatnonzero(np.isfinite(factors[0])).tolist()
        names = [rows.label_names[label] for label in ranged]
        found["by_label"] = tuple(map(LabelNoise, names, *np.clip(factors[:, ranged], *_LIMITS).tolist()))
    steps = len(rows.rest)
    motion = slice(system.first_motion, system.first_motion + 6 * steps)
    if "odometry" in kinds and steps:
        told = np.column_stack([residual[motion], probes[motion], kept[motion]])
        pushed = np.swapaxes(whitens, 1, 2) @ told.reshape(-1, 6, 1 + 2 * count)
        for k, name in enumerate(("along", "across", "turning")):
            variance = found[name] ** 2
            axis = rows.motion_axes[k]
            root_of_part = np.sqrt(np.maximum(np.einsum("kii->k", rows.parts[k]), 0.0) / (axis**2).sum(axis=1))
            sums = rows.by_motion_window @ (root_of_part[:, None] * np.einsum("ki,kip->kp", axis, pushed))
            own, first, second = sums[:, 0], sums[:, 1 : 1 + count], sums[:, 1 + count :]
            share = len(own) / steps
            squares = share * variance**2 * (own**2).sum()
            redundancy = share * variance * (first * second).sum() / count
            found[name] = np.sqrt((prior + squares) / (prior + max(redundancy, 0.0)))
    for kind in _KINDS:
        found[kind] = float(np.clip(found[kind], *_LIMITS))
    return replace(noise, **found)


def _ray_noise(rows: _Rows, factor: float, residual: Floats, probes: Floats, kept: Floats, prior: float) -> float:
    """Return the factor on the noise of rays. It is larger if the rays of one object have correlated errors for some time.

    The mean of absolute values is used, because it is robust. The larger factor of azimuth and elevation counts, because a
    sensor may fix one of the two.
    """
    axes, count = rows.bearing_axes, len(rows.bearing_weight)
    off = np.einsum("njk,nk->nj", axes, residual[: 2 * count].reshape(-1, 2)) / np.sqrt(rows.bearing_weight)[:, None]
    one, two = (np.einsum("njk,nkp->njp", axes, m[: 2 * count].reshape(count, 2, -1)) for m in (probes, kept))
    largest = 0.0
    told = np.concatenate([off[:, :, None], one, two], axis=2).reshape(count, -1)
    for summed, size in ((told, 1), (rows.by_ray_window @ told, np.bincount(rows.ray_window))):
        groups = len(summed)
        found = summed.reshape(groups, 2, -1) / np.sqrt(size).reshape(-1, 1, 1)
        sums, first, second = found[:, :, 0], found[:, :, 1 : 1 + probes.shape[1]], found[:, :, 1 + probes.shape[1] :]
        redundancy = (first * second).sum(axis=(0, 2)) / probes.shape[1]
        squares = groups * (np.abs(sums).mean(axis=0) * _MEAN_NORMAL * factor) ** 2
        largest = max(largest, float(((prior + squares) / (prior + np.maximum(redundancy, 0.0))).max()))
    return float(np.sqrt(largest))


def _sums_in(window: Ints) -> sparse.csr_matrix:
    """Return the matrix (W, n) whose product with rows (n, D) sums them in each window (n,)."""
    return sparse.csr_matrix((np.ones(len(window)), (window, np.arange(len(window)))))


def _range_rows(of: Linearised, errors: CalibratedMeasurements) -> RangeNoise:
    """Return the ranges of a graph with their nominal noise."""
    which = of.which[np.isfinite(of.measured.rays.range[of.which])]
    owner, rays = of.association.object[which], errors.rays.take(which)
    return RangeNoise(owner, rays.label, of.association.label, rays.range_sigma, rays.range_bias)


def _range_sigma(rows: _Rows, noise: NoiseFactors) -> Floats:
    """Return the noise (q,), m, of ranges, with their part of the object's bias."""
    return rows.ranges.total(noise.of_labels(rows.label_names))


def _motion_covariance(rows: _Rows, noise: NoiseFactors) -> Floats:
    """Return the covariances (s, 6, 6) of the motions."""
    variances = np.array([noise.along, noise.across, noise.turning]) ** 2
    total = np.asarray(rows.rest + np.tensordot(variances, rows.parts, 1))
    return total if rows.motions is None else rows.motions.with_noise(total).covariance


def _azimuth_elevation(directions: Floats, base_T_camera: Floats) -> Floats:
    """Return matrices (n, 2, 2) from bearing residuals in GTSAM's basis to azimuth and elevation in the base frame."""
    basis = tangent_basis(directions)
    up = base_T_camera[:, 2, :3]
    elevation = up - (up * directions).sum(axis=1, keepdims=True) * directions
    length = np.linalg.norm(elevation, axis=1, keepdims=True)
    elevation = np.where(length > 1e-6, elevation / np.maximum(length, 1e-12), basis[:, :, 0])
    axes = np.stack([np.cross(directions, elevation), elevation], axis=1)
    return np.asarray(axes @ basis)
