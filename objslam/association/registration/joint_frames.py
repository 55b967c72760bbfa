"""Solve the frames of many maps, the positions of their objects, and the errors that the objects of each map share.

Each map measures its objects in a frame of its own. A frame has x, y, z and yaw, because z is up in all maps. The first
frame is the frame of the result. All objects of a map share an error: a shift, a turn and a wrong size
(`core.maps.shared_covariance`). The shared error is also a variable, and its covariance is the prior. So a map whose size is
uncertain takes the size of a map whose size is known. The time of a Gauss-Newton step grows with the number of measurements,
and with the cube of the number of objects or of maps, whichever is smaller (`ArrowSystem`). Cauchy's weights limit the
effect of moved objects.

The errors that are not shared may be larger than the covariances say. Objects are nudged, and their boxes differ from day to
day. The residuals show this. With at least three maps, the variance of each map is estimated against all others (variance
components; Helmert 1907, Foerstner 1979). Two maps have one common variance.
"""

from dataclasses import dataclass, replace

import numpy as np
from scipy.special import gammaincinv

from objslam.association.registration.arrow_system import ArrowSystem
from objslam.core.arrays import Floats, Ints
from objslam.core.geometry import lift_se2, split_se2
from objslam.core.maps.shared_covariance import NUMBERS, jacobian
from objslam.core.statistics import HALF_RAY

_STEPS = 30
"""The most Gauss-Newton steps. More are slower. Fewer than ten are usual from a registration."""
_ROUNDS = 10
"""The most estimates of the maps' noise, each followed by a solve. More are slower, and hardly change the noise."""
_SAME_NOISE = 0.02
"""The least relative change of the noise after which the noise is estimated again. A larger value ends sooner."""
_FEWEST_MAPS = 3
"""The least number of maps with which each map has a noise of its own. With fewer maps, all maps have one noise, because the
residuals of two maps do not show which map is worse. With a larger number, one noise is used for more maps."""
_POOLED = 10.0
"""The weight of a map's given covariances, as a number of residuals. A larger number trusts the covariances more. At 10, a
map of a few objects keeps its covariances, and a map of a few dozen is judged by its residuals."""
_AGAIN = 0.01
"""The standard deviation (m) that is added to each measured position, as an error that is not shared. Without it, one pair
of nearly exact objects would fix the shared errors. A larger value trusts small distances in maps less."""
_SQUARES = 2 * gammaincinv(1.5, (np.arange(50) + 0.5) / 50)
"""Squared lengths of normal residuals (chi-squared, 3 degrees of freedom) at equal steps of probability. The mean over them
gives the expectation of a weighted squared residual. More steps give this expectation more exactly."""
_STILL = 1e-6
"""The largest step (m, rad) that ends the solve. A larger value ends it sooner. With Cauchy's weights, each step is about
half of the previous step. So at the end the positions are wrong by about the length of this step, which is a thousandth of
the errors of the best maps."""


@dataclass(frozen=True)
class Measured:
    """R measurements: map (R,) has object (R,) at position (R, 3) m in its own frame.

    A map has an object once at most. covariance: (R, 3, 3) m^2, without the shared errors. roots: (S, 7, 7) `root_of` the
    covariances of the shared errors of the S maps, None if no map has any.
    """

    map: Ints
    object: Ints
    position: Floats
    covariance: Floats
    roots: Floats | None = None


@dataclass(frozen=True)
class JointFrames:
    """S frames and N objects in the frame of the first map.

    site_T_map: (S, 4, 4) the poses of the frames. frame_covariance: (S, 4, 4) the covariance of x, y, z (m) and yaw (rad) of
    each frame, 0 for the first frame. positions, covariance: (N, 3) m and (N, 3, 3) m^2 of the objects. own: (N, 3, 3) m^2,
    the part of the covariance from errors that an object has alone. correlated: (N, 3, m) m, the rest, as a factor of the
    joint covariance. weight: (R,) the weight of each measurement, in [0, 1]. noise: (S,) the factor, at least 1, on the
    covariances of the errors that are not shared. It is 1 for one map alone.
    """

    site_T_map: Floats
    frame_covariance: Floats
    positions: Floats
    covariance: Floats
    own: Floats
    correlated: Floats
    weight: Floats
    noise: Floats


@dataclass(frozen=True)
class _State:
    """A solve of S maps.

    errors: (S, 7) the shared errors, in units of their roots. taken: (S,) the degrees of freedom that the frame and the
    shared error of each map take from its residuals.
    """

    found: JointFrames
    errors: Floats
    taken: Floats


def solve_frames(measured: Measured, site_T_map: Floats, count: int, *, judged: bool = True) -> JointFrames:
    """Solve S frames, from the start site_T_map (S, 4, 4), and the positions of `count` objects. Each object has at least
    one measurement.

    Each frame must share at least two objects with the first, directly or through other frames. If one does not, the
    covariances of all frames after the first are NaN. judged: whether the noise of the maps is estimated.
    """
    roots = measured.roots
    if roots is None or not roots.any():
        roots = np.zeros((len(site_T_map), NUMBERS, 0))
    measured = replace(measured, roots=roots)
    if len(site_T_map) > 1:
        measured = replace(measured, covariance=measured.covariance + _AGAIN**2 * np.eye(3))
    noise = np.ones(len(site_T_map))
    at = _solve(measured, site_T_map, count, noise, np.zeros((len(site_T_map), roots.shape[2])))
    for _ in range(_ROUNDS if judged and len(site_T_map) > 1 else 0):
        noise = _noise(measured, at)
        if np.abs(noise / at.found.noise - 1).max() < _SAME_NOISE:
            break
        at = _solve(measured, at.found.site_T_map, count, noise, at.errors)
    return at.found


def _noise(measured: Measured, at: _State) -> Floats:
    """Return the factor (S,) on the covariances of each map: its squared residuals divided by their expectation."""
    found = at.found
    moved, _, rotation = _moved(measured, _frames(found.site_T_map), at.errors, found.positions)
    claimed = np.linalg.inv(rotation @ measured.covariance @ np.swapaxes(rotation, 1, 2))
    counted = claimed * (found.weight / found.noise[measured.map])[:, None, None]
    total = _sums(counted, measured.object, len(found.positions))
    share = np.trace(counted @ np.linalg.inv(total)[measured.object], axis1=1, axis2=2)
    miss = found.positions[measured.object] - moved
    squares = found.weight * np.einsum("ri,rij,rj->r", miss, claimed, miss)
    maps = len(found.noise)
    left = np.clip(1 - share / 3, 0.0, 1.0)[:, None] * _SQUARES
    expected = np.bincount(measured.map, (left / (1 + left / HALF_RAY)).mean(axis=1), maps)
    coordinates = np.bincount(measured.map, 3 - share, maps)
    free = expected * np.maximum(1 - at.taken / np.maximum(coordinates, 1e-9), 0.0)
    own = np.bincount(measured.map, squares, maps)
    if maps < _FEWEST_MAPS:
        free, own = np.full(maps, free.sum()), np.full(maps, own.sum())
    return np.maximum((own + _POOLED) / (free + _POOLED), 1.0)


def _frames(poses: Floats) -> Floats:
    """Return x, y, z and yaw (S, 4) of poses (S, 4, 4)."""
    return np.column_stack([poses[:, :3, 3], split_se2(poses)[0][:, 2]])


def _solve(measured: Measured, site_T_map: Floats, count: int, noise: Floats, errors: Floats) -> _State:
    measured = replace(measured, covariance=measured.covariance * noise[measured.map, None, None])
    x = _frames(site_T_map)
    weight = np.ones(len(measured.object))
    alone = np.bincount(measured.object, minlength=count)[measured.object] < 2
    positions: Floats | None = None
    for _ in range(_STEPS):
        moved, lever, rotation = _moved(measured, x, errors, positions)
        plain = np.linalg.inv(rotation @ measured.covariance @ np.swapaxes(rotation, 1, 2))
        information = plain * weight[:, None, None]
        total = _sums(information, measured.object, count)
        pulls = _sums((information @ moved[..., None])[..., 0], measured.object, count)
        positions = np.asarray(np.linalg.solve(total, pulls[..., None])[..., 0], dtype=np.float64)
        miss = positions[measured.object] - moved
        system, gradient = _linearised(measured, lever, information, total, miss, errors)
        step = system.step(gradient)
        x, errors = x + step[:, :4], errors + step[:, 4:]
        if np.abs(step).max(initial=0.0) < _STILL:
            break
        weight = np.where(alone, 1.0, 1 / (1 + np.einsum("ri,rij,rj->r", miss, plain, miss) / HALF_RAY))
    # Normal residuals also have weights below 1. Without a division by their mean, the covariances would be too large.
    information = information / _mean_weight(information, total, measured.object)[:, None, None]
    total = _sums(information, measured.object, count)
    system, _ = _linearised(measured, lever, information, total, miss, errors)
    own, correlated, spread = system.covariances()
    spread[0, :4], spread[0, :, :4] = 0.0, 0.0  # The first frame stays.
    assert positions is not None
    poses = lift_se2(x[:, [0, 1, 3]])
    poses[:, 2, 3] = x[:, 2]
    covariance = own + correlated @ np.swapaxes(correlated, 1, 2)
    known = 4 + errors.shape[1] - np.diagonal(spread, axis1=1, axis2=2)[:, 4:].sum(axis=1)
    # The frame of the result is a free choice, so its 4 coordinates are not taken from the residuals of any one map.
    taken = np.maximum(np.nan_to_num(known), 4.0) - 4.0 / len(x)
    found = JointFrames(poses, spread[:, :4, :4], positions, covariance, own, correlated, weight, noise)
    return _State(found, errors, taken)


def _mean_weight(information: Floats, total: Floats, object_: Ints) -> Floats:
    """Return the mean weight (R,) that normal residuals would have. information: (R, 3, 3) of the measurements. total: (N,
    3, 3), the sum of the information about each object."""
    share = np.trace(information @ np.linalg.inv(total)[object_], axis1=1, axis2=2)
    left = np.clip(1 - share / 3, 0.0, 1.0)[:, None] * _SQUARES  # The fit of the position makes residuals smaller.
    return np.asarray((1 / (1 + left / HALF_RAY)).mean(axis=1))


def _moved(measured: Measured, x: Floats, errors: Floats, positions: Floats | None) -> tuple[Floats, Floats, Floats]:
    """Return the measurements (R, 3) without shared errors (S, r), in the frame of the result, and rotations (R, 3, 3).

    Also return their Jacobians (R, 3, 4 + r) by the frame x (S, 4) and the shared errors of their map. positions: (N, 3) m,
    the objects so far, None before the first step.
    """
    assert measured.roots is not None
    poses = lift_se2(x[:, [0, 1, 3]])[measured.map]
    rotation = poses[:, :3, :3]
    at = measured.position
    if positions is not None:
        # Derivatives at the measured positions would make all maps shrink, because a smaller world has smaller residuals.
        at = (np.swapaxes(rotation, 1, 2) @ (positions[measured.object] - x[measured.map, :3])[..., None])[..., 0]
    shared = jacobian(at) @ measured.roots[measured.map]
    local = measured.position - (shared @ errors[measured.map][..., None])[..., 0]
    turned = (rotation @ local[..., None])[..., 0]
    lever = np.zeros((len(turned), 3, 4 + errors.shape[1]))
    lever[:, :, :3] = np.eye(3)
    lever[:, 0, 3], lever[:, 1, 3] = -turned[:, 1], turned[:, 0]
    lever[:, :, 4:] = -rotation @ shared
    return turned + x[measured.map, :3], lever, rotation


def _linearised(
    measured: Measured, lever: Floats, information: Floats, total: Floats, miss: Floats, errors: Floats
) -> tuple[ArrowSystem, Floats]:
    """Return the linear system of objects, frames and shared errors, and the right side (S, 4 + r) of all maps."""
    maps, shared = errors.shape
    pull = information @ lever
    own = _sums(np.swapaxes(lever, 1, 2) @ pull, measured.map, maps)
    own[:, 4:, 4:] += np.eye(shared)  # The prior of the shared errors.
    gradient = _sums((np.swapaxes(pull, 1, 2) @ miss[..., None])[..., 0], measured.map, maps)
    gradient[:, 4:] -= errors
    # The first frame stays. Its shared errors do not.
    pull[measured.map == 0, :, :4] = 0.0
    own[0, :4], own[0, :, :4], gradient[0, :4] = 0.0, 0.0, 0.0
    own[0, :4, :4] = np.eye(4)
    return ArrowSystem(total, own, pull, measured.object, measured.map), gradient


def _sums(values: Floats, group: Ints, count: int) -> Floats:
    sums = np.zeros((count, *values.shape[1:]))
    np.add.at(sums, group, values)
    return sums
