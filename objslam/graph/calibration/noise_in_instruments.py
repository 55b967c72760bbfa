"""Estimate the noise of the odometry in the derivatives by scales and clocks."""

from collections.abc import Callable

import numpy as np

from objslam.core.arrays import Floats
from objslam.core.calibration import CalibratedMeasurements
from objslam.core.geometry import inverse, log_se3
from objslam.errors import SolveError
from objslam.graph.calibration.information import RIDGE
from objslam.graph.calibration.instruments import Motions, from_neighbours
from objslam.graph.calibration.linearised_graph import Linearised
from objslam.graph.calibration.shared_error_jacobian import LinearSystem

_AXES_OF = {"odometry.scale": (3, 4), "odometry.lateral_scale": (4,), "odometry.turn_scale": (2,)}
"""The indices of the components of a twist that each scale parameter multiplies."""
_PROBES = 4
"""The number of random probes. More probes are more exact and slower. With 4, the error of a product is a small part of the
standard deviation of the gradient."""


def noise_shares(of: Linearised, system: LinearSystem, errors: CalibratedMeasurements) -> Floats:
    """Return the shares (P, P) of the information about the shared errors that come from noise of the odometry.

    The shares of scales are on the diagonal, and the shares of clocks are a block (`_shares`). Only clocks and the scales of
    the odometry have such noise, because their sides (`LinearSystem.sides`) contain measured motions. A side without its
    best fit by poses and landmarks (`LinearSystem.left`) is called the rest of the side here. The information is the sum of
    the squares of this rest.

    For a scale, the noise in the information is the expected product of two noises: that of its instrument, and that of the
    rest of its side. The instrument has the noise of the neighbours of each motion. This noise is independent of the noise
    of the motion itself, but the fit by poses spreads the noise of a motion over its neighbours. For a clock, the noise in
    the information is the expected square of the noise in the rest of its side.

    Both expectations are traces of matrices, which random probes estimate (Hutchinson 1990). A probe is a random walk with
    steps at the stamps of the odometry, because keyframes between two stamps share a step.

    The roughness of the measured motions and the residuals of the solution each give a size of the noise. The smaller size
    counts. Motions that were commanded and not measured are smooth. Their residuals come from the robot, so the sides have
    no noise.

    The share of a clock is at least the share of the motions that are below ties (`Motions.tied`). For such motions, the
    solved path is the instrument of clocks, for the following reason. An interpolated pose averages the noise of two poses
    of the odometry, so it has less noise midway between them. So a clock offset that moves the ends of ties to the middle
    seems to fit better. For motions between keyframes, this effect cancels, because keyframes lie anywhere in a step. But
    all ties end at about the same share of a step if the rates of images and odometry have a simple ratio. On simulated
    wheels that slip, with one pose in a second, this moved a clock by 0.09 s.
    """
    names, instruments = errors.names, system.clocks
    clocks = {} if instruments is None else instruments.moved
    scales = {k: _AXES_OF[name] for k, name in enumerate(names) if name in _AXES_OF}
    motions, stamps, (before, after) = system.motions, of.measured.keyframes.stamps, of.graph.moves
    if motions is None or not (scales or clocks):
        return np.zeros((len(names), len(names)))
    sigma = motions.by_odometry * np.sqrt(np.einsum("kii->ki", motions.covariance))
    sigma /= np.sqrt(np.maximum(motions.seconds, 1e-9))[:, None]
    walks = _random_walks(errors.odometry_stamps)
    at = walks(stamps)
    walk = at[after] - at[before]
    rates, at_poses = {}, {}
    for k, mine in clocks.items():
        step = errors.steps[k]
        at_poses[k] = (walks(stamps + step) - walks(stamps - step)) / (2 * step)
        rate = mine[:, None] * at_poses[k]
        rates[k] = rate[after] - rate[before]
    of_pose = np.zeros((len(stamps), 6))
    of_pose[before], of_pose[after] = sigma, sigma  # The noise around a pose is that of a motion that starts or ends there.
    odometry = of.measured.keyframes.odom_T_base
    assert odometry is not None
    said = log_se3(inverse(odometry[before]) @ odometry[after]) / sigma
    residual = system.left(system.residual[:, None])[motions.rows]
    products, between = np.zeros(len(names)), np.zeros((len(clocks), len(clocks)))
    for axis in (2, 3, 4):

        def rows(steps: Floats, axis: int = axis) -> Floats:
            """Return the rows (6 s, n) of the linear system for noise (s, n) of the motions along the axis."""
            noise = np.zeros((len(sigma), 6, steps.shape[1]))
            noise[:, axis] = sigma[:, axis, None] * steps
            return motions.whitened(noise)

        probes = np.zeros((len(system.residual), _PROBES * (1 + len(clocks))))
        probes[motions.rows] = rows(np.hstack([walk, *rates.values()]))
        for i, k in enumerate(rates):
            velocity = np.zeros((len(stamps), 6, _PROBES))
            velocity[:, axis] = -of_pose[:, axis, None] * at_poses[k]  # Opposite to the motions, as in the sides.
            assert instruments is not None
            instruments.across.put(probes[:, _PROBES * (1 + i) : _PROBES * (2 + i)], k, velocity)
        of_all = system.left(probes)
        left = of_all[motions.rows]
        along = rows(np.ones((len(sigma), 1)))
        fits = _energy(np.repeat(motions.by_odometry[:, axis], 6)[:, None] * along * residual) / max(
            _energy(along * left[:, :_PROBES]), 1e-12
        )
        rough = _roughness(said[:, [axis]], motions) / max(_roughness(walk, motions), 1e-12)
        size = min(rough**2, fits)
        for k, axes in scales.items():
            if axis in axes:
                noise = np.zeros((len(sigma), 6, _PROBES))
                noise[:, axis] = sigma[:, axis, None] * walk
                told = motions.weighted(motions.predicted(noise))
                products[k] += size * float((told * left[:, :_PROBES]).sum()) / _PROBES
        of_clocks = (one[:, _PROBES:].reshape(len(one), len(rates), _PROBES) for one in (probes, of_all))
        between += size * np.einsum("mip,mjp->ij", *of_clocks) / _PROBES
    sides = system.left(system.sides)
    shares = np.diag(products / np.maximum((sides**2).sum(axis=0), 1e-300))
    own = sides[:, list(rates)]
    shares[np.ix_(list(rates), list(rates))] = _shares(between, own.T @ own, motions.tied)
    return shares


def _shares(noise: Floats, information: Floats, least: float) -> Floats:
    """Return the shares (C, C) of noise in the information about C clocks, between `least` and 1 in each direction.

    noise, information: (C, C). The product of information and shares is the noise, except for the limits. The frames of
    several cameras have the same odometry, so their clocks share its noise. This noise hardly disturbs the difference of two
    clocks, but it disturbs their mean. SolveError if a number is not finite.
    """
    size = np.sqrt(np.maximum(np.diagonal(information), 1e-300))
    told, told_noise = information / np.outer(size, size), noise / np.outer(size, size)
    if not (np.isfinite(told).all() and np.isfinite(told_noise).all()):
        raise SolveError("the information about the clocks is not finite")
    root = np.linalg.cholesky(told + RIDGE * np.eye(len(told)))
    back = np.linalg.inv(root)
    found, axes = np.linalg.eigh(back @ told_noise @ back.T)
    shares = back.T @ (axes * np.clip(found, least, 1.0)) @ axes.T @ root.T
    return np.asarray(shares * size / size[:, None])


def _random_walks(stamps: Floats) -> Callable[[Floats], Floats]:
    """Return a function from times (n,), s, to the values (n, probes) of random walks with steps at `stamps` (m,), s."""
    rng = np.random.default_rng(0)
    steps = rng.standard_normal((len(stamps) - 1, _PROBES)) * np.sqrt(np.maximum(np.diff(stamps), 0.0))[:, None]
    walks = np.vstack([np.zeros((1, _PROBES)), np.cumsum(steps, axis=0)])
    return lambda at: np.column_stack([np.interp(at, stamps, walk) for walk in walks.T])


def _roughness(values: Floats, motions: Motions) -> float:
    """Return the median absolute difference between values (n, D) of motions and their prediction by neighbours."""
    return float(np.median(np.abs(values - from_neighbours(values, motions.seconds, motions.moment))))


def _energy(rows: Floats) -> float:
    """Return the sum over the motions of the squared sums of their 6 rows (6 n, D), as a mean over the D columns."""
    return float((rows.reshape(-1, 6, rows.shape[1]).sum(axis=1) ** 2).sum()) / rows.shape[1]
