"""Estimate the errors of the places from which a log was recorded, such as places by GPS.

All boxes of one moment share the error of the place of this moment. A box alone cannot show this error. But if several boxes
of a moment have landmarks that other moments also see, the error follows from all of them together.
"""

from dataclasses import dataclass

import numpy as np

from objslam.association.landmarks import State
from objslam.association.observations import MIN_DEPTH
from objslam.core.arrays import Floats, Ints
from objslam.core.statistics import grouped_sums

_HALF = 3.0
"""The squared deviation at which a ray has half of its full weight. On 30 simulated streets, 2 and 4 give the same objects,
and 6 finds 1 % fewer. With a larger value, rays of other things pull more."""
_DENSE = 500
"""Up to this number of landmarks, the normal equations are a dense matrix, because things in a room are seen together. With
more landmarks, the matrix is sparse, because the things lie along a way, and hardly any two are seen from one place. The
time of a dense solve grows with the cube of the number of landmarks."""
_STEPS = 8
"""The number of steps of the robust fit. A larger number is more exact and slower."""
_WIDE = 3
"""The number of first steps in which the errors of the places count as noise of the residuals. Later steps estimate these
errors. With fewer first steps, rays of other things pull more."""


@dataclass(frozen=True)
class PlaceErrors:
    """The estimated errors of G places. offset: (G, 3) m, from the given to the estimated place, in map. sigma: (G,) m, the
    standard deviation of the estimated place along each axis. place: (R,) the place of each ray."""

    offset: Floats
    sigma: Floats
    place: Ints


def moments(state: State) -> Ints:
    """Return the index (R,) of the moment of each ray, in time order."""
    return np.asarray(np.unique(state.view.stamps[state.obs.frame], return_inverse=True)[1])


def place_errors(state: State) -> PlaceErrors:
    """Estimate the errors of all places from the rays that have a landmark.

    The landmarks and the places are the least-squares solution of the rays, with Cauchy weights, and with the noise of the
    origins as the prior of the places. The sigma of a place includes the errors of the landmarks. These errors come from the
    other places that see the landmarks.
    """
    held, owner, count = state.assigned, state.owner, state.count
    obs, prior = state.obs.take(held), state.obs.position_sigma**2
    place = moments(state)
    of, places = place[held], int(place.max(initial=-1)) + 1
    known, n = np.isfinite(obs.range), obs.direction
    along = n[:, :, None] * n[:, None, :]
    across = np.eye(3) - along
    told = obs.origin + np.where(known, obs.range, 0.0)[:, None] * n  # Where the ray says that its landmark is.
    ranged = np.where(known, obs.range_sigma, np.inf) ** 2
    position, offset = state.landmarks.position, np.zeros((places, 3))
    for step in range(_STEPS):
        to = position[owner] - offset[of] - obs.origin
        distance2 = np.maximum((to * to).sum(axis=1), MIN_DEPTH**2)
        depth = (to * n).sum(axis=1)
        wide = prior * max(0.0, 1 - step / _WIDE) ** 2
        aside, ahead = obs.sigma**2 * distance2, np.where(known, depth - obs.range, 0.0) ** 2
        one = 1 / aside / (1 + (distance2 - depth**2).clip(min=0.0) / (aside + wide) / _HALF)
        two = 1 / ranged / (1 + ahead / (ranged + wide) / _HALF)
        weight = one[:, None, None] * across + two[:, None, None] * along
        position, offset = _solved(weight, told, owner, of, position, places, prior)
    return PlaceErrors(offset, _sigma(weight, owner, of, count, places, prior), place)


def _solved(
    weight: Floats, told: Floats, owner: Ints, of: Ints, position: Floats, places: int, prior: float
) -> tuple[Floats, Floats]:
    """Return the positions (N, 3) and the offsets (G, 3) that minimise the weighted squares of `position - offset - told`.

    weight: (P, 3, 3) m^-2, of each ray. told: (P, 3) m, where each ray says that its landmark is. owner, of: (P,) the
    landmark and the place of each ray. prior: m^2, the variance of an offset. A landmark stays at its position in directions
    that no ray observes.
    """
    from scipy.sparse import bsr_array
    from scipy.sparse.linalg import spsolve

    count = len(position)
    pull = (weight @ (told - position[owner])[:, :, None])[:, :, 0]
    by_landmark, by_place = grouped_sums(pull, owner, count), -grouped_sums(pull, of, places)
    own = [
        grouped_sums(weight.reshape(-1, 9), index, size).reshape(-1, 3, 3) for index, size in ((owner, count), (of, places))
    ]
    inverse = np.linalg.inv(own[1] + np.eye(3) / prior)
    # There are more places than landmarks. So the places are eliminated first, and a small system remains.
    order = np.argsort(of, kind="stable")
    begin = np.searchsorted(of[order], np.arange(places + 1))
    between = bsr_array((-weight[order], owner[order], begin), shape=(3 * places, 3 * count)).tocsr()
    carried = bsr_array((-(inverse[of] @ weight)[order], owner[order], begin), shape=(3 * places, 3 * count)).tocsr()
    landmarks = own[0] + 1e-6 / prior * np.eye(3)
    matrix = (
        bsr_array((landmarks, np.arange(count), np.arange(count + 1)), shape=(3 * count, 3 * count)) - between.T @ carried
    )
    right = by_landmark.ravel() - carried.T @ by_place.ravel()
    moved = np.linalg.solve(matrix.toarray(), right) if count <= _DENSE else spsolve(matrix.tocsc(), right)
    offset = (inverse @ (by_place - (between @ moved).reshape(-1, 3))[:, :, None])[:, :, 0]
    return position + moved.reshape(-1, 3), offset


def _sigma(weight: Floats, owner: Ints, of: Ints, count: int, places: int, prior: float) -> Floats:
    """Return the standard deviations (G,), m, of the offsets of the places.

    A ray tells as much about its place as the other rays tell about its landmark. The computation is one round of belief
    propagation (Weiss and Freeman, Neural Computation 13, 2001).
    """
    alone = weight - weight @ np.linalg.solve(weight + np.eye(3) / prior, weight)  # With the errors of the place as noise.
    others = grouped_sums(alone.reshape(-1, 9), owner, count).reshape(-1, 3, 3)[owner] - alone
    told = weight - weight @ np.linalg.solve(weight + others + 1e-6 / prior * np.eye(3), weight)
    information = grouped_sums(told.reshape(-1, 9), of, places).reshape(-1, 3, 3) + np.eye(3) / prior
    return np.asarray(np.sqrt(np.trace(np.linalg.inv(information), axis1=1, axis2=2) / 3))
