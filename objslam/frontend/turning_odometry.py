"""Find the error of the odometry's turns before any map: at the right turns, the rays of each track meet in a point."""

import numpy as np

from objslam.core.arrays import Floats, Ints
from objslam.core.statistics import NORMAL_MEDIAN
from objslam.core.types import Keyframes, Rays
from objslam.frontend.shared_errors import SharedErrors

TURN_SCALE = "odometry.turn_scale"
_LONGEST = 1.0
"""The longest time (s) between two boxes of a track that follow each other. Over a longer time, the robot drives past the
thing, and the next box is not where the odometry expects it."""
_NEAR = np.radians(6.0)
"""The largest angle (rad) between a ray and the ray before it in its track, turned by the odometry. A thing beside the robot
moves by 5 degrees if the robot drives 8 % of its distance between the images. A larger angle joins neighbours more often."""
_TURN, _TIME = 0.6, 4.0
"""A window ends after this turn (rad), or after this time (s). In a larger window, a track spans more of the turn, but the
odometry errs by more than one factor."""
_LEAST_TURN = 0.15
"""The least turn (rad) of a window. With less, parallax and noise of the rays hide the error of the turn."""
_MOST, _STEP = 0.3, 0.02
"""The largest error that is tried, as a share of the turns, and the step between errors. The cost of a window is a parabola
around the best error, so a smaller step is only slower."""
_CLIP = 9.0
"""The largest squared deviation of a ray. A deviation above it counts as this value. With a larger value, a false link of a
track has more influence."""
_FEWEST = 3
"""The fewest rays of a track in a window. Two rays nearly always meet."""
_WINDOWS = 5
"""The fewest windows for an estimate of the error. Fewer windows do not show how far they disagree."""
_FLAT = 1e-4
"""The weight of a point 5 m ahead, in rays. It only makes the point of parallel rays finite."""


def with_turns_of_tracks(errors: SharedErrors, theta: Floats) -> Floats:
    """Return shared errors (P,), but with the error of the odometry's turns that the tracks of boxes show.

    A track is a chain of boxes of one label. Each box is near the place where the odometry expects the box before it. While
    the robot turns, the rays of a track meet in one point only at poses that turn by the right angles. Each window of the
    drive gives an estimate of the error. The weighted median of these estimates is combined with the prior, weighted by
    their variances. The noise of the median is the noise of turns in the settings, or more if the windows disagree by more.

    The first association of a drive takes this error as given. With turns that err by 8 %, a half turn at the end of an
    aisle errs by 14 degrees. Things that are seen again from the next aisle are then taken for their neighbours.

    Args:
        errors: of the measured keyframes and rays.
        theta: (P,) the values at which the tracks are judged, such as those with the clocks that turns show.
    """
    if TURN_SCALE not in errors.names or errors.keyframes.odom_T_base is None or not len(errors.rays):
        return theta
    number = errors.names.index(TURN_SCALE)
    mean, prior = float(errors.mean[number]), float(errors.prior[number, number])
    factor, variance = _of_windows(errors, theta, number)
    if len(factor) < _WINDOWS:
        return theta
    weight = 1 / variance
    order = np.argsort(factor)
    middle = factor[order][np.searchsorted(np.cumsum(weight[order]), weight.sum() / 2)]
    apart = float(np.median(np.abs(factor - middle) * np.sqrt(weight))) / NORMAL_MEDIAN
    told = max(1.0, apart) ** 2 / float(weight.sum())
    result = theta.copy()
    result[number] = (middle / told + mean / prior) / (1 / told + 1 / prior)
    return result


def _of_windows(errors: SharedErrors, theta: Floats, number: int) -> tuple[Floats, Floats]:
    """Return the error (W,) of the turns in each window that determines it, and its variance (W,)."""
    keyframes, rays, settings = errors.at(theta, drift=False)
    window, turn = _windows(keyframes)
    _, track, length = np.unique(
        _tracks(keyframes, rays) * len(turn) + window[rays.keyframe], return_inverse=True, return_counts=True
    )
    mine = np.flatnonzero((length >= _FEWEST)[track])
    some, track = rays.take(mine), np.unique(track[mine], return_inverse=True)[1]
    tried = theta[number] + np.arange(-_MOST, _MOST + _STEP / 2, _STEP)
    cost = np.zeros((len(tried), len(turn)))
    at = theta.copy()
    for i, value in enumerate(tried.tolist()):
        at[number] = value
        moved, _, _ = errors.at(at, drift=False)
        squared = np.minimum(_deviations(moved, some, track), _CLIP)
        cost[i] = np.bincount(window[some.keyframe], squared, len(turn))
    best = cost.argmin(axis=0)
    inside = np.flatnonzero((best > 0) & (best < len(tried) - 1) & (turn >= _LEAST_TURN))
    before, least, after = (cost[best[inside] + step, inside] for step in (-1, 0, 1))
    bend = before - 2 * least + after
    sharp = bend > 0
    inside, bend = inside[sharp], bend[sharp]
    factor = tried[best[inside]] + _STEP * (before - after)[sharp] / (2 * bend)
    of_odometry = settings.odometry.yaw_per_rad**2 / turn[inside]
    return factor, 2 * _STEP**2 / bend + of_odometry


def _windows(keyframes: Keyframes) -> tuple[Ints, Floats]:
    """Return the window (K,) of each keyframe, and the turn (W,), rad, in each window."""
    assert keyframes.odom_T_base is not None
    rotation = keyframes.odom_T_base[:, :3, :3]
    trace = np.einsum("kij,kij->k", rotation[:-1], rotation[1:])
    turned = np.append(0.0, np.cumsum(np.arccos(np.clip((trace - 1) / 2, -1.0, 1.0))))
    cells = np.stack([turned // _TURN, (keyframes.stamps - keyframes.stamps[0]) // _TIME])
    window = np.unique(cells, axis=1, return_inverse=True)[1].ravel()
    first, last = np.full(window.max() + 1, np.inf), np.zeros(window.max() + 1)
    np.minimum.at(first, window, turned)
    np.maximum.at(last, window, turned)
    return window, last - first


def _tracks(keyframes: Keyframes, rays: Rays) -> Ints:
    """Return the track (R,) of each ray: the index of its first ray.

    A ray continues the track of a ray in the previous image if each of the two is the nearest ray of its label to the other.
    """
    assert keyframes.odom_T_base is not None
    odom_R_camera = (keyframes.odom_T_base @ keyframes.base_T_camera)[:, :3, :3]
    direction = np.einsum("rij,rj->ri", odom_R_camera[rays.keyframe], rays.direction)
    one, two = _neighbours(keyframes, rays)
    cosine = np.einsum("pi,pi->p", direction[one], direction[two])
    near = np.flatnonzero(cosine > np.cos(_NEAR))
    one, two, cosine = one[near], two[near], cosine[near]
    forward, backward = np.full((2, len(rays)), -1.0)
    np.maximum.at(forward, one, cosine)
    np.maximum.at(backward, two, cosine)
    linked = (cosine == forward[one]) & (cosine == backward[two])
    root = np.arange(len(rays))
    root[two[linked]] = one[linked]
    while (root[root] != root).any():
        root = root[root]
    return root


def _neighbours(keyframes: Keyframes, rays: Rays) -> tuple[Ints, Ints]:
    """Return the pairs (P,) of rays of one label in images of one camera that follow each other."""
    group = rays.label * (int(keyframes.camera.max(initial=0)) + 1) + keyframes.camera[rays.keyframe]
    order = np.lexsort((rays.keyframe, group))
    changes = np.flatnonzero((np.diff(group[order]) != 0) | (np.diff(rays.keyframe[order]) != 0)) + 1
    begin = np.append(0, changes)
    end = np.append(changes, len(order))
    first = order[begin]
    apart = np.diff(keyframes.stamps[rays.keyframe[first]])
    follow = np.flatnonzero((np.diff(group[first]) == 0) & (apart > 0) & (apart <= _LONGEST))
    many, more = (end - begin)[follow], (end - begin)[follow + 1]
    pair = np.repeat(np.arange(len(follow)), many * more)
    step = np.arange(len(pair)) - np.repeat(np.cumsum(many * more) - many * more, many * more)
    one = begin[follow][pair] + step // more[pair]
    two = begin[follow + 1][pair] + step % more[pair]
    return order[one], order[two]


def _deviations(keyframes: Keyframes, rays: Rays, track: Ints) -> Floats:
    """Return the squared deviation (R,) of each ray from the point that is nearest to all rays of its track."""
    assert keyframes.odom_T_base is not None
    origin, direction = rays.in_map(keyframes.odom_T_base @ keyframes.base_T_camera)
    count = int(track.max(initial=-1)) + 1
    across = np.eye(3) - direction[:, :, None] * direction[:, None, :]
    ahead = origin + 5.0 * direction
    left, right = np.zeros((count, 3, 3)), np.zeros((count, 3))
    np.add.at(left, track, across + _FLAT * np.eye(3))
    np.add.at(right, track, np.einsum("rij,rj->ri", across, origin) + _FLAT * ahead)
    to = np.linalg.solve(left, right[..., None])[track, :, 0] - origin
    along = np.einsum("ri,ri->r", to, direction)
    off = np.linalg.norm(np.cross(to, direction), axis=1)
    return np.where(along > 0, (np.arctan2(off, along) / rays.sigma) ** 2, np.inf)
