"""Find the clocks of cameras before any map: bearings turn against the robot's turns at the right offset of the clock."""

import numpy as np

from objslam.core.arrays import Floats, Ints
from objslam.core.calibration import kind
from objslam.core.types import Trajectory
from objslam.frontend.shared_errors import SharedErrors

_STEP = 0.02
"""The distance (s) between the tried offsets. A solve converges from ten times as far, so a smaller step is only slower."""
_LONGEST = 1.0
"""The longest time (s) between two bearings that are compared. Over a longer time, the robot drives past the object, and its
bearing changes without a turn."""
_MOST = 20_000
"""The most pairs of bearings of a camera that are compared, spread over the log. A larger number is slower."""
_SURE = 5.0
"""The least log odds of an offset against the expected one. With a smaller value, robots that hardly turn begin at an offset
by chance. With a larger value, short drives begin at a wrong clock."""


def clocks_of_turns(errors: SharedErrors) -> Floats:
    """Return shared errors (P,) from which a search can begin: their mean, but with the clocks that the robot's turns show.

    Two bearings of one label from neighbouring images differ by the turn of the robot between the images, and by parallax.
    The offset at which they differ least from the turns of the odometry is judged with the prior of the clock, by Laplace's
    distribution of unknown width. A search that begins at a clock 0.2 s off can end at a wrong optimum, where a large noise
    of turns takes the place of the clock.
    """
    theta, odometry, cameras = errors.mean.copy(), errors.log.odometry, [one.camera.name for one in errors.log.cameras]
    if odometry is None or errors.keyframes.odom_T_base is None:
        return theta
    limit = errors.settings.calibration.max_clock
    offsets = np.arange(-limit, limit + _STEP / 2, _STEP)
    for k, name in enumerate(errors.names):
        if kind(name) != "clock":
            continue
        stamps, turned, weight = _pairs(errors, cameras.index(name.rpartition(".")[0]))
        if not len(stamps):
            continue
        missed = _missed(odometry, stamps, turned, np.append(offsets, theta[k]))
        floor = float(np.median(errors.rays.sigma))
        cost = weight * np.log(missed + floor)
        cost += (np.append(offsets, theta[k]) - errors.mean[k]) ** 2 / (2 * errors.prior[k, k])
        best = int(cost.argmin())
        if cost[best] < cost[-1] - _SURE:
            theta[k] = offsets[best]
    return theta


def _pairs(errors: SharedErrors, camera: int) -> tuple[Floats, Floats, float]:
    """Return the stamps (n, 2), s, of pairs of bearings of one label, and how far (n,), rad, the bearing turned in base.

    The last value is the number of independent pairs: pairs of the same images share the turn, and each image is in two.
    Labels with several boxes in an image have no pairs there.
    """
    keyframes, rays = errors.keyframes, errors.rays
    mine = np.flatnonzero(keyframes.camera[rays.keyframe] == camera)
    _, first, number = np.unique(
        np.stack([rays.label[mine], rays.keyframe[mine]]), axis=1, return_index=True, return_counts=True
    )
    single = mine[first[number == 1]]  # In the order of the labels, then of the keyframes.
    one, two = single[:-1], single[1:]
    stamps = np.column_stack([keyframes.stamps[rays.keyframe[one]], keyframes.stamps[rays.keyframe[two]]])
    apart = stamps[:, 1] - stamps[:, 0]
    near = np.flatnonzero((rays.label[one] == rays.label[two]) & (apart > 0) & (apart <= _LONGEST))
    images = len(np.unique(rays.keyframe[two[near]]))
    share = min(_MOST / max(len(near), 1), 1.0)
    near = near[np.unique(np.round(np.linspace(0, len(near) - 1, int(share * len(near)))).astype(np.int64))]
    azimuth = _azimuths(errors, single)
    return stamps[near], _wrapped(azimuth[near + 1] - azimuth[near]), images / 2


def _azimuths(errors: SharedErrors, which: Ints) -> Floats:
    """Return the directions (n,), rad, of rays (n,) about the vertical axis of base."""
    rays = errors.rays
    turn = errors.keyframes.base_T_camera[rays.keyframe[which], :3, :3]
    in_base = np.einsum("nij,nj->ni", turn, rays.direction[which])
    return np.arctan2(in_base[:, 1], in_base[:, 0])


def _missed(odometry: Trajectory, stamps: Floats, turned: Floats, offsets: Floats) -> Floats:
    """Return the mean absolute difference (m,), rad, between the turns of bearings and those of the odometry.

    stamps: (n, 2) s and turned: (n,) rad, of `_pairs`. offsets: (m,) s, of the clock.
    """
    heading = np.unwrap(np.arctan2(odometry.poses[:, 1, 0], odometry.poses[:, 0, 0]))
    found = np.zeros(len(offsets))
    for i, offset in enumerate(offsets.tolist()):
        before, after = np.interp(stamps.T + offset, odometry.stamps, heading)
        found[i] = np.abs(_wrapped(turned + after - before)).mean()
    return found


def _wrapped(angles: Floats) -> Floats:
    """Return angles in [-pi, pi)."""
    return np.asarray((angles + np.pi) % (2 * np.pi) - np.pi)
