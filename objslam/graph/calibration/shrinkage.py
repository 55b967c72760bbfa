"""Compute how much a joint solution shrinks because noise in the rays makes the path jitter (Neyman and Scott 1948)."""

import numpy as np

from objslam.core.arrays import Floats
from objslam.core.geometry import adjoint, inverse, is_planar, log_se3
from objslam.graph.calibration.instruments import from_neighbours, moment_of
from objslam.graph.calibration.linearised_graph import Linearised
from objslam.graph.factors.localized_rows import LocalizedRows

_LEAST_TOLD = 0.3
"""The share of the squared motions above which their prediction by neighbours is used in `shrinking_force`. With a larger
share, the prediction is used more rarely."""

_HEIGHT = 5
"""The index of the upward motion in a twist of the robot's base. The rotation comes first in a twist."""


def shrinking_force(of: Linearised) -> tuple[float, float]:
    """Return the force that makes a joint solution too small, and the curvature of the cost.

    Both are derivatives of the cost by the logarithm of the map's size. Noise in the rays makes the path jitter, so its
    steps are longer than the steps of the odometry. A smaller map makes the steps shorter again at the least cost (errors in
    variables; Neyman and Scott 1948). The motion residuals pull on the size. Part of the pull is real, and part comes from
    the noise of the measured motions. Motions that are predicted from their neighbours do not have this noise, and show the
    real part. The force is the total pull minus the real part, at least 0. If the prediction is poor (`_LEAST_TOLD`), the
    force is the total pull. Without odometry, or with a localisation, the force is 0. The curvature is the information of
    all measured lengths about the size.
    """
    keyframes, rays = of.measured.keyframes, of.measured.rays.take(of.which)
    before, after = of.graph.moves
    odometry = of.measured.motions
    if odometry is None or not len(odometry) or keyframes.localized_every or keyframes.odom_T_base is None:
        return 0.0, 1.0
    camera_T_base = inverse(keyframes.base_T_camera)
    solved, said = (
        (inverse(path[before]) @ path[after])[:, :3, 3] for path in (of.map_T_camera @ camera_T_base, keyframes.odom_T_base)
    )
    turn = keyframes.base_T_camera[after, :3, :3]
    variance = turn @ odometry.covariance[:, 3:, 3:] @ np.swapaxes(turn, 1, 2)
    seconds = np.maximum(keyframes.stamps[after] - keyframes.stamps[before], 0.0)
    told = from_neighbours(said, seconds, moment_of(keyframes))

    def product(one: Floats, two: Floats) -> float:
        return float((one * np.linalg.solve(variance, two[..., None])[..., 0]).sum())

    ways, by_neighbours = product(said, said), product(told, said)
    force = product(solved, solved - said)
    if by_neighbours > _LEAST_TOLD * ways:
        force -= product(told, solved - said) * ways / by_neighbours
    ranged = np.isfinite(rays.range)
    lengths = ways + float(((rays.range[ranged] / rays.range_sigma[ranged]) ** 2).sum()) + _of_tags(of)
    return max(force, 0.0), max(lengths, 1.0)


def force_of_heights(of: Linearised) -> float:
    """Return the force with which heights make a solution at localised, planar poses too small.

    The force is a derivative of the cost, as in `shrinking_force`. Noise in the rays, and ground that is not flat, lift and
    lower the solved poses. Planar poses do not measure heights. Their noise only says how large heights may be. In a smaller
    map, all heights are smaller and cost less, but this says nothing about the true size. The motions by odometry are left
    out, because their noise follows the odometry's scale.
    """
    keyframes = of.measured.keyframes
    if not keyframes.localized_every or not is_planar(keyframes.map_T_base):
        return 0.0
    off, roots, _ = of.graph.absolute_roots(of.map_T_camera)
    force = _by_heights(keyframes.base_T_camera, off, roots)
    for rows in of.graph.further:
        if isinstance(rows, LocalizedRows):
            off = log_se3(inverse(rows.of.motion) @ rows.moved(of.map_T_camera))
            force += _by_heights(keyframes.base_T_camera[rows.of.after], off, rows.weighted_roots(of.map_T_camera))
    return force


def _by_heights(base_T_camera: Floats, off: Floats, roots: Floats) -> float:
    """Return the derivative of the cost by the logarithm of a factor on all heights.

    base_T_camera: (n, 4, 4). off: (n, 6) the twists between solved and measured poses or motions, in the camera frames.
    roots: (n, 6, 6) matrices that whiten the twists.
    """
    height = (adjoint(base_T_camera)[:, _HEIGHT] * off).sum(axis=1)
    raised = adjoint(inverse(base_T_camera))[:, :, _HEIGHT] * height[:, None]
    return float(((roots @ off[..., None]) * (roots @ raised[..., None])).sum())


def _of_tags(of: Linearised) -> float:
    """Return the information that the known sizes of fiducials give about the logarithm of the size of the map.

    A view gives the distance to a fiducial from the directions of its four corners. Each corner is half a diagonal from the
    centre.
    """
    tags = of.measured.tags
    if tags is None:
        return 0.0
    seen = tags.seen(of.measured.rays, of.map_T_camera)
    across = np.linalg.norm(seen.direction[:, 2] - seen.direction[:, 0], axis=1)
    known = np.isfinite(tags.side)[seen.square]
    return float(((across[known] / seen.sigma[known]) ** 2).sum())
