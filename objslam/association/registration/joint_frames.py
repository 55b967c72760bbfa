"""Solve the frames of many maps and the positions of their objects together.

Each map measures its objects in a frame of its own. A frame has x, y, z and yaw, because z is up in all maps. The first
frame is the frame of the result. Each Gauss-Newton step eliminates the objects first, because each object is a block of its
own (Schur complement). So its time grows with the number of measurements, and with the cube of the number of frames, which
are few. Cauchy's weights limit the influence of an object that a map has at another place.

A map may be worse than it says. Where at least three maps overlap, the residuals tell: the noise of each map is estimated
against that of the others (variance components; Helmert 1907, Foerstner 1979), and a worse map counts less.
"""

from dataclasses import dataclass, replace

import numpy as np

from objslam.core.arrays import Floats, Ints
from objslam.core.geometry import lift_se2, split_se2
from objslam.core.statistics import HALF_RAY

_STEPS = 30
"""The most Gauss-Newton steps. More are slower. Fewer than ten are usual from a registration."""
_ROUNDS = 10
"""The most estimates of the maps' noise, each followed by a solve. More are slower, and hardly change the noise."""
_SAME_NOISE = 0.02
"""The relative change of the noise below which it is not estimated again. A larger change ends sooner."""
_FEWEST_MAPS = 3
"""The least number of maps whose residuals tell which of them is worse. The residuals of two maps are alike."""
_POOLED = 10.0
"""The claimed covariances of a map count as this number of coordinates of residuals. A larger number trusts the claims
longer. At 10, a map of a few objects keeps its claims, and one of a few dozen is judged by its residuals."""
_STILL = 1e-9
"""The largest step (m, rad) that ends the solve. A larger value ends it sooner."""


@dataclass(frozen=True)
class Measured:
    """R measurements: map (R,) has object (R,) at position (R, 3) m in its own frame, with covariance (R, 3, 3) m^2."""

    map: Ints
    object: Ints
    position: Floats
    covariance: Floats


@dataclass(frozen=True)
class JointFrames:
    """S frames and N objects in the frame of the first map.

    site_T_map: (S, 4, 4). frame_covariance: (S, 4, 4) of x, y, z (m) and yaw (rad) of each, 0 for the first. positions:
    (N, 3) m. covariance: (N, 3, 3) m^2. weight: (R,) the weight of each measurement, in [0, 1]. noise: (S,) the factor on
    the variance of each map against that of all maps, 1 for fewer than three maps.
    """

    site_T_map: Floats
    frame_covariance: Floats
    positions: Floats
    covariance: Floats
    weight: Floats
    noise: Floats


def solve_frames(measured: Measured, site_T_map: Floats, count: int) -> JointFrames:
    """Solve S frames, from the start site_T_map (S, 4, 4), and the positions of `count` objects. Each object has a
    measurement.

    Each frame must share at least two objects with the others, directly or through other frames. If one does not, the
    covariances of all frames after the first are NaN.
    """
    noise = np.ones(len(site_T_map))
    found = _solve(measured, site_T_map, count, noise)
    if len(site_T_map) < _FEWEST_MAPS:
        return found
    for _ in range(_ROUNDS):
        noise = _noise(measured, found)
        if np.abs(noise / found.noise - 1).max() < _SAME_NOISE:
            break
        found = _solve(measured, found.site_T_map, count, noise)
    return found


def _noise(measured: Measured, found: JointFrames) -> Floats:
    """Return the factor (S,) on the variance of each map, from its residuals and its share in the objects (redundancy)."""
    rotation = found.site_T_map[measured.map, :3, :3]
    moved = (rotation @ measured.position[..., None])[..., 0] + found.site_T_map[measured.map, :3, 3]
    claimed = np.linalg.inv(rotation @ measured.covariance @ np.swapaxes(rotation, 1, 2))
    counted = claimed * (found.weight / found.noise[measured.map])[:, None, None]
    total = _sums(counted, measured.object, len(found.positions))
    share = np.trace(counted @ np.linalg.inv(total)[measured.object], axis1=1, axis2=2)
    miss = found.positions[measured.object] - moved
    squares = found.weight * np.einsum("ri,rij,rj->r", miss, claimed, miss)
    maps = len(found.noise)
    free, own = np.bincount(measured.map, 3 - share, maps), np.bincount(measured.map, squares, maps)
    level = max(own.sum() / max(free.sum(), 1e-9), 1e-9)  # The factor by which all maps claim too small variances.
    return np.asarray((own / level + _POOLED) / (free + _POOLED))


def _solve(measured: Measured, site_T_map: Floats, count: int, noise: Floats) -> JointFrames:
    measured = replace(measured, covariance=measured.covariance * noise[measured.map, None, None])
    frames = len(site_T_map)
    x = np.column_stack([site_T_map[:, :3, 3], split_se2(site_T_map)[0][:, 2]])
    weight = np.ones(len(measured.object))
    for _ in range(_STEPS):
        moved, lever, rotation = _moved(measured, x)
        information = np.linalg.inv(rotation @ measured.covariance @ np.swapaxes(rotation, 1, 2)) * weight[:, None, None]
        total = _sums(information, measured.object, count)
        positions = np.linalg.solve(
            total, _sums((information @ moved[..., None])[..., 0], measured.object, count)[..., None]
        )
        positions = positions[..., 0]
        miss = positions[measured.object] - moved
        system, gradient, half = _reduced(measured, lever, information, total, miss, frames)
        step = np.zeros((frames, 4))
        if frames > 1:
            step[1:] = np.linalg.lstsq(system, gradient, rcond=None)[0].reshape(-1, 4)
        x = x + step
        if np.abs(step).max() < _STILL:
            break
        plain = np.linalg.inv(rotation @ measured.covariance @ np.swapaxes(rotation, 1, 2))
        alone = np.bincount(measured.object, minlength=count)[measured.object] < 2
        weight = np.where(alone, 1.0, 1 / (1 + np.einsum("ri,rij,rj->r", miss, plain, miss) / HALF_RAY))
    spread = np.zeros((4 * frames, 4 * frames))
    if frames > 1:
        held = np.linalg.cond(system) < 1e14
        spread[4:, 4:] = np.linalg.inv(system) if held else np.nan
    covariance = np.linalg.inv(total)
    gain = covariance[:, None] @ half  # (N, S, 3, 4): how each object moves with each frame.
    flat = np.swapaxes(gain, 1, 2).reshape(count, 3, 4 * frames)
    covariance = covariance + flat @ np.nan_to_num(spread) @ np.swapaxes(flat, 1, 2)
    poses = lift_se2(x[:, [0, 1, 3]])
    poses[:, 2, 3] = x[:, 2]
    blocks = np.array([spread[4 * s : 4 * s + 4, 4 * s : 4 * s + 4] for s in range(frames)])
    symmetric = np.asarray((covariance + np.swapaxes(covariance, 1, 2)) / 2)
    return JointFrames(poses, blocks, np.asarray(positions), symmetric, weight, noise)


def _moved(measured: Measured, x: Floats) -> tuple[Floats, Floats, Floats]:
    """Return the measurements (R, 3) in the frame of the result, their Jacobians (R, 3, 4) by their frame, and rotations."""
    poses = lift_se2(x[:, [0, 1, 3]])[measured.map]
    rotation = poses[:, :3, :3]
    turned = (rotation @ measured.position[..., None])[..., 0]
    lever = np.zeros((len(turned), 3, 4))
    lever[:, :, :3] = np.eye(3)
    lever[:, 0, 3], lever[:, 1, 3] = -turned[:, 1], turned[:, 0]
    return turned + x[measured.map, :3], lever, rotation


def _reduced(
    measured: Measured, lever: Floats, information: Floats, total: Floats, miss: Floats, frames: int
) -> tuple[Floats, Floats, Floats]:
    """Return the system and the right side for the frames after the first, and the information (N, S, 3, 4) that ties each
    object to each frame."""
    count = len(total)
    pull = information @ lever
    half = np.zeros((count, frames, 3, 4))
    np.add.at(half, (measured.object, measured.map), pull)
    own = _sums(np.swapaxes(lever, 1, 2) @ pull, measured.map, frames)
    flat = np.swapaxes(half, 1, 2).reshape(count, 3, 4 * frames)
    system = -np.einsum("nia,nij,njb->ab", flat, np.linalg.inv(total), flat, optimize=True)
    for s in range(frames):
        system[4 * s : 4 * s + 4, 4 * s : 4 * s + 4] += own[s]
    gradient = _sums((np.swapaxes(pull, 1, 2) @ miss[..., None])[..., 0], measured.map, frames).reshape(-1)
    return system[4:, 4:], gradient[4:], half


def _sums(values: Floats, group: Ints, count: int) -> Floats:
    sums = np.zeros((count, *values.shape[1:]))
    np.add.at(sums, group, values)
    return sums
