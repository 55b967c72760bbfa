"""Landmarks that come into view again after a long way: whether they can be trusted to be those.

By then the gate around each is so wide that something not known yet may stand in it. Several of them at once tell more: one
error of the pose must explain all their offsets, and what the others say of it leaves little room for each.
"""

from __future__ import annotations

import numpy as np

from objslam.association.landmarks import Landmarks, variance
from objslam.association.matches import across
from objslam.association.sightings import Sightings
from objslam.geometry import skew
from objslam.live.expected import Expected
from objslam.types import Bools, Floats, Ints

_ODDS = 4.5  # log odds of a landmark, given the others, against something not known yet
_REACH, _TALL = 4.0, 1.0  # m; a room that holds objects is that long and wide and tall, at the least
_ALONG = 1e-6


def trusted(s: Sightings, landmarks: Landmarks, doubt: Floats, map_T_camera: Floats, unknown: Floats) -> Bools:
    """Which of the rays (n,) of one frame are of the landmark (n,) that each has.

    doubt: (6, 6) covariance of the camera's pose against these landmarks, in its own frame. unknown: (n,) objects of the
    label, not known yet, that are expected for each steradian where the ray looks. A landmark stays where it is so much
    likelier than those, given all others that stay.
    """
    to = landmarks.position - s.origin
    distance = np.linalg.norm(to, axis=1)
    axes = across(s.direction)
    offset = np.einsum("nij,nj->ni", axes, to)
    turn = map_T_camera[:3, :3]
    jacobian = np.concatenate([axes @ skew(to) @ turn, -axes @ turn], axis=2).reshape(-1, 6)
    total = (jacobian @ doubt @ jacobian.T).reshape(len(s), 2, len(s), 2)
    own = axes @ landmarks.covariance @ np.swapaxes(axes, 1, 2)
    own += variance(s, distance, landmarks.noise)[:, None, None] * np.eye(2)
    each, both = np.arange(len(s)), np.arange(2)
    total[each, :, each] += own
    rare = -np.log(2 * np.pi * np.maximum(unknown, 1e-12) / distance**2)
    left = each
    while len(left):
        precision = np.linalg.inv(total[np.ix_(left, both, left, both)].reshape(2 * len(left), -1))
        pull = (precision @ offset[left].ravel()).reshape(-1, 2)
        rest = precision.reshape(len(left), 2, len(left), 2)[np.arange(len(left)), :, np.arange(len(left))]
        squared = np.einsum("ni,ni->n", pull, np.linalg.solve(rest, pull[:, :, None])[:, :, 0])
        odds = rare[left] + (np.log(np.linalg.det(rest)) - squared) / 2
        worst = int(odds.argmin())
        if odds[worst] >= _ODDS:
            break
        left = np.delete(left, worst)
    return np.isin(each, left)


def expected_unknown(s: Sightings, rows: Ints, expected: Expected, novelty: float) -> Floats:
    """How many objects of the label of each landmark, rows (n,), not known yet, there are for each steradian along a ray.

    There are taken to be as many of them for each known one as there were boxes of something unknown, of late, for each box
    of a known one (novelty), spread evenly over the room: seen up to where the ray leaves it, or the eye gives out.
    """
    position, label = expected.position[: expected.landmarks], expected.label[: expected.landmarks]
    low, high = position.min(axis=0), position.max(axis=0)
    per_m3 = novelty * np.bincount(label)[label[rows]] / np.prod(np.maximum(high - low, [_REACH, _REACH, _TALL]))
    ahead = s.direction[:, :2]
    ahead = np.where(np.abs(ahead) < _ALONG, np.copysign(_ALONG, ahead), ahead)
    wall = (np.where(ahead > 0, high[:2], low[:2]) - s.origin[:, :2]) / ahead
    distance = np.linalg.norm(position[rows] - s.origin, axis=1)
    return np.asarray(per_m3 * np.clip(wall.min(axis=1), distance, max(expected.far, _REACH)) ** 3 / 3)
