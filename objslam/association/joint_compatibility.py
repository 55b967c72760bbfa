"""Test the joint compatibility (after Neira & Tardos, JCBB, 2001) of landmarks that reappear after a long way.

After a long way, gates are wide and may contain unknown objects. So a single pose error must explain all residuals together.
"""

import numpy as np

from objslam.association.gating import tangent_basis
from objslam.association.landmarks import Landmarks, PredictedLandmarks
from objslam.association.observations import Observations
from objslam.association.refinement import variance
from objslam.core.arrays import Bools, Floats, Ints
from objslam.core.rotation import skew

_MIN_ODDS = 4.5  # The least log odds of "the ray's landmark" over "an unknown object". Larger odds keep fewer rays.
_MIN_ROOM, _MIN_HEIGHT = 4.0, 1.0
"""The least length or width (m), and the least height (m), of a room with objects. With larger values, unknown objects are
sparser in small rooms, so more rays are kept."""
_MIN_SLOPE = 1e-6  # The least component of a direction used as a divisor.


def jointly_compatible(
    obs: Observations, landmarks: Landmarks, doubt: Floats, map_T_camera: Floats, unknown: Floats
) -> Bools:
    """Return which rays (n,) of one frame really belong to their landmarks (n,).

    The least likely ray is removed until each ray left is much more likely to show its landmark than an unknown object.
    doubt: (6, 6) covariance of the camera's pose relative to the landmarks, in camera coordinates, rotation first. unknown:
    (n,) expected number of unknown objects per steradian along each ray, with the label of the ray.
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
    """Return the expected number (n,) of unknown objects with the label of the ray's landmark, per steradian along each ray.

    Unknown objects are assumed to be everywhere in the room, and to be visible as far as a landmark was seen. rows: (n,) the
    landmark of each ray. novelty: the recent number of boxes of unknown objects for each box of a known object. This number
    is taken as the ratio of unknown to known objects.
    """
    position, label = expected.position[: expected.landmarks], expected.label[: expected.landmarks]
    low, high = position.min(axis=0), position.max(axis=0)
    per_m3 = novelty * np.bincount(label)[label[rows]] / np.prod(np.maximum(high - low, [_MIN_ROOM, _MIN_ROOM, _MIN_HEIGHT]))
    ahead = obs.direction[:, :2]
    ahead = np.where(np.abs(ahead) < _MIN_SLOPE, np.copysign(_MIN_SLOPE, ahead), ahead)
    wall = (np.where(ahead > 0, high[:2], low[:2]) - obs.origin[:, :2]) / ahead
    distance = np.linalg.norm(position[rows] - obs.origin, axis=1)
    return np.asarray(per_m3 * np.clip(wall.min(axis=1), distance, max(expected.far, _MIN_ROOM)) ** 3 / 3)
