"""Find boxes without an object that follow one another from frame to frame: a thing that moves."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from objslam.association.existence import rest_odds
from objslam.core.arrays import Bools, Floats, Ints
from objslam.core.statistics import grouped_median
from objslam.mapping.doubts.chance import LEAST_LOG_ODDS
from objslam.mapping.doubts.evidence import Evidence
from objslam.mapping.doubts.points import MISSED, Points, as_landmarks, fit_points

_FEWEST = 6
"""The fewest boxes of a group. A larger number finds fewer groups."""
_SPEED = np.radians(25.0)
"""The highest angular speed (rad/s), seen from the camera, of a thing whose boxes follow one another. A larger value follows
faster things, and joins more boxes by chance."""
_LAGS = (1, 2, 3)
"""The numbers of frames after which the next box of a moving thing may come. Larger numbers bridge more missed detections,
and join more boxes by chance."""
_FAR_LAGS = (50, 51, 52)
"""The numbers of frames after which two boxes no longer show the same motion. Such pairs show how often boxes follow one
another by chance."""
_ALIKE = 1.5
"""The largest ratio between the sizes of two boxes that follow one another. A larger ratio joins more boxes by chance."""
_SMOOTH = 0.25
"""The largest `_jitter` of a thing that moves. Noise has 1, and a smooth motion nearly 0. A larger value finds more things
that move, and also boxes that jump about one place."""
_SIGMAS = 3.0
"""The most standard deviations of noise by which two boxes that follow one another may differ from the motion. A larger
number joins more boxes by chance."""


def moving_things(evidence: Evidence, left: Ints) -> Iterator[Ints]:
    """Yield groups of rays whose boxes follow one another, while no point at rest explains them.

    The least number of boxes follows from how often boxes follow one another by chance in this log. left: (M,) the rays
    without an object, in the order of frames.
    """
    if len(left) < _FEWEST:
        return
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    frame = _frame_of_camera(evidence)[left]
    one, two = _links(evidence, left, frame, _LAGS, evidence.state.obs.direction)
    rotation = evidence.state.view.map_T_camera[evidence.state.obs.frame, :3, :3]
    in_camera = np.einsum("rji,rj->ri", rotation, evidence.state.obs.direction)  # Chance boxes are anywhere in images.
    by_chance = (len(_links(evidence, left, frame, _FAR_LAGS, in_camera)[0]) + 1) / (len(left) + 2)
    least = max(_FEWEST, 1 + (np.log(len(left)) + LEAST_LOG_ODDS) / -np.log(by_chance))
    graph = coo_array((np.ones(len(one)), (one, two)), shape=(len(left), len(left)))
    part = connected_components(graph, directed=False)[1]
    order = np.argsort(part, kind="stable")
    groups = [left[each] for each in np.split(order, np.flatnonzero(np.diff(part[order])) + 1) if len(each) >= least]
    points = fit_points(evidence, groups)
    moves = (points.deviation > MISSED) | (rest_odds(as_landmarks(evidence, points))[evidence.state.count :] < 0)
    moves &= _jitter(evidence, points) < _SMOOTH
    yield from (group for group, yes in zip(groups, moves, strict=True) if yes)


def _jitter(evidence: Evidence, points: Points) -> Floats:
    """Return the jitter (G,) of groups: half of von Neumann's ratio (1941), by medians.

    The jitter compares the steps between consecutive rays with the offsets of the rays from their point. It is 1 for
    independent offsets, and near 0 for a smooth motion.
    """
    obs, count = evidence.state.obs, len(points.position)
    to = points.position[points.group] - obs.origin[points.ray]
    distance = np.maximum(np.linalg.norm(to, axis=1), 1e-6)
    across = to - np.einsum("qi,qi->q", to, obs.direction[points.ray])[:, None] * obs.direction[points.ray]
    offset = across / (distance * obs.sigma[points.ray])[:, None]
    within = np.diff(points.group) == 0
    step = (np.diff(offset, axis=0) ** 2).sum(axis=1)[within]
    usual = grouped_median((offset**2).sum(axis=1), points.group, count)  # Medians, because a false box may be among them.
    return np.asarray(grouped_median(step, points.group[1:][within], count) / np.maximum(2 * usual, 1e-12))


def _frame_of_camera(evidence: Evidence) -> Ints:
    """Return the number (R,) of the frame of each ray among the frames of its camera."""
    camera = evidence.state.view.camera
    order = np.argsort(camera, kind="stable")
    number = np.empty(len(camera), dtype=np.int64)
    number[order] = np.arange(len(camera)) - np.searchsorted(camera[order], camera[order])
    return number[evidence.state.obs.frame]


def _links(evidence: Evidence, left: Ints, frame: Ints, lags: tuple[int, ...], direction: Floats) -> tuple[Ints, Ints]:
    """Return pairs (P,) of indices into `left`: each box, and the nearest similar box some frames later.

    The first lag with such a box counts. frame: (M,) the number of each frame within its camera. direction: (R, 3) of all
    rays, in a frame in which the thing hardly moves between two frames.
    """
    obs, view = evidence.state.obs, evidence.state.view
    width = int(frame.max()) + max(lags) + 2
    series = view.camera[obs.frame[left]] * len(evidence.state.unassigned) + obs.label[left]
    key = series * width + frame
    order = np.argsort(key, kind="stable")
    stamp, size = view.stamps[obs.frame[left]], np.sqrt(obs.size[left].prod(axis=1))
    pairs: list[tuple[Ints, Ints]] = []
    free: Bools = np.ones(len(left), dtype=bool)
    for lag in lags:
        begin, end = (np.searchsorted(key[order], key + lag, side=side) for side in ("left", "right"))
        number = np.where(free, end - begin, 0)
        first = np.repeat(np.arange(len(left)), number)
        second = order[np.repeat(begin, number) + np.arange(number.sum()) - np.repeat(np.cumsum(number) - number, number)]
        angle = _angle(direction[left[first]], direction[left[second]])
        # Far lags measure how often boxes follow by chance, so they get the angle of a near lag.
        seconds = (stamp[second] - stamp[first]) / lag * (lags.index(lag) + 1)
        noise = _SIGMAS * np.hypot(obs.sigma[left[first]], obs.sigma[left[second]])
        ratio = size[second] / np.maximum(size[first], 1e-9)
        good = (angle < _SPEED * seconds + noise) & (ratio < _ALIKE) & (ratio > 1 / _ALIKE)
        first, second, angle = first[good], second[good], angle[good]
        nearest = np.lexsort((angle, first))
        first, second = first[nearest], second[nearest]
        kept = np.append(True, np.diff(first) > 0)[: len(first)]
        pairs.append((first[kept], second[kept]))
        free[first] = False
    return np.concatenate([p[0] for p in pairs]), np.concatenate([p[1] for p in pairs])


def _angle(one: Floats, two: Floats) -> Floats:
    """Return the angle (P,), rad, between unit vectors (P, 3)."""
    return np.asarray(2 * np.arcsin(np.clip(np.linalg.norm(one - two, axis=1) / 2, 0.0, 1.0)))
