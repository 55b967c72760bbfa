"""Joint compatibility (after Neira & Tardos, JCBB, 2001) of landmarks that come into view again after a long way.

By then the gate around each is so wide that something unknown may stand in it. Several at once tell more: one error of the
pose must explain all their offsets, and what the others say about it leaves little room for each.
"""

from __future__ import annotations

import numpy as np

from objslam.association.gating import tangent_basis
from objslam.association.landmarks import Landmarks, PredictedLandmarks
from objslam.association.observations import Observations
from objslam.association.refinement import variance
from objslam.core.arrays import Bools, Floats, Ints
from objslam.core.geometry import skew

_MIN_ODDS = 4.5  # The least log odds of a landmark, given the others, against something unknown; larger trusts fewer.
_MIN_ROOM, _MIN_HEIGHT = 4.0, 1.0  # The least length and width, and the least height (m), of a room that holds objects.
_MIN_SLOPE = 1e-6  # The least component of a direction that is divided by.


def jointly_compatible(
    obs: Observations, landmarks: Landmarks, doubt: Floats, map_T_camera: Floats, unknown: Floats
) -> Bools:
    """Which rays (n,) of one frame really are of the landmark (n,) that each one has.

    A landmark stays if it is much likelier than an unknown object, given all others that stay.

    Args:
        doubt: (6, 6) covariance of the camera's pose relative to these landmarks, in its own frame.
        unknown: (n,) expected objects of the label, not known yet, per steradian where the ray looks.
    """
    to = landmarks.position - obs.origin
    distance = np.linalg.norm(to, axis=1)
    axes = tangent_basis(obs.direction)
    offset = np.einsum("nij,nj->ni", axes, to)
    turn = map_T_camera[:3, :3]
    jacobian = np.concatenate([axes @ skew(to) @ turn, -axes @ turn], axis=2).reshape(-1, 6)
    total = (jacobian @ doubt @ jacobian.T).reshape(len(obs), 2, len(obs), 2)
    own = axes @ landmarks.covariance @ np.swapaxes(axes, 1, 2)
    own += variance(obs, distance, landmarks.noise)[:, None, None] * np.eye(2)
    each, both = np.arange(len(obs)), np.arange(2)
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
        if odds[worst] >= _MIN_ODDS:
            break
        left = np.delete(left, worst)
    return np.isin(each, left)


def unknown_density(obs: Observations, rows: Ints, expected: PredictedLandmarks, novelty: float) -> Floats:
    """Expected objects (n,) per steradian along each ray that have the label of its landmark, rows (n,), and are not known.

    novelty: boxes of something unknown for each box of a known object, of late. Unknown objects are taken to be to the known
    ones as that, spread evenly over the room, and visible until the ray leaves it or things get too small.
    """
    position, label = expected.position[: expected.landmarks], expected.label[: expected.landmarks]
    low, high = position.min(axis=0), position.max(axis=0)
    per_m3 = novelty * np.bincount(label)[label[rows]] / np.prod(np.maximum(high - low, [_MIN_ROOM, _MIN_ROOM, _MIN_HEIGHT]))
    ahead = obs.direction[:, :2]
    ahead = np.where(np.abs(ahead) < _MIN_SLOPE, np.copysign(_MIN_SLOPE, ahead), ahead)
    wall = (np.where(ahead > 0, high[:2], low[:2]) - obs.origin[:, :2]) / ahead
    distance = np.linalg.norm(position[rows] - obs.origin, axis=1)
    return np.asarray(per_m3 * np.clip(wall.min(axis=1), distance, max(expected.far, _MIN_ROOM)) ** 3 / 3)
