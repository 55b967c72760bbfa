"""Estimate the noise of a log from the residuals of objects with few boxes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from objslam.association.observations import MIN_DEPTH
from objslam.core.arrays import Bools, Floats, Ints
from objslam.core.noise import MOST_POSE_NOISE
from objslam.core.statistics import grouped_sums
from objslam.mapping.fixed.few_box_search import Searched, SparseNoise
from objslam.mapping.fixed.pose_noise import least_cost

_FAR = 10.0
"""The prior standard deviation of an object's place, as a multiple of the largest distance along a ray. With this prior, an
object with a single ray has a finite variance. A large number hardly matters."""
_OUTLIER = 3.0
"""The deviation, in standard deviations, from which a residual does not count after the first round. With a smaller limit,
the noise becomes too small. With a larger limit, wrong depths count."""
_LEFT = 0.5
"""The error of a place that is left after the search corrected the place, as a share of the noise of the places. It only
widens the limit for outliers, so with a larger share, fewer residuals are rejected. On simulated streets it is 0.4 to
0.6."""
_ROUNDS = 3
"""The number of rounds in which the noise is estimated. Several are needed, because the outliers depend on the noise. With a
larger number, the noise is more exact, and the estimate is slower."""
_MOST = (MOST_POSE_NOISE, 20.0, 20.0)
"""The largest factors on the noise of places, depths and boxes. With the default settings, a factor of 20 means that a depth
errs by 40 % and a box by 60 px. With larger factors, wrong input is taken for noise."""


def noise_of_residuals(searched: Searched, unknown: tuple[bool, bool, bool], prior: float, *, shared: bool) -> SparseNoise:
    """Return the noise of places, depths and boxes that agrees best with the residuals. It has the largest restricted
    posterior density (Patterson and Thompson 1971).

    A place is the position of the robot at one moment. The residuals are seen from above. Across the ray, a residual comes
    from the noise of the box and of the place. Along the ray, it comes from the noise of the depth and of the place. The
    objects and the errors of the places are integrated out. unknown: whether the noise of places, of depths and of boxes is
    estimated. prior: the weight of the noise in the settings, as a number of residuals. shared: whether all rays of one
    moment have the same error of their place. If not, each ray has an error of its own, and no residual is left out as an
    outlier.
    """
    residuals = _Residuals.of(searched)
    known, own = residuals.known, residuals.own
    place = searched.found.moment if shared else np.arange(len(searched.found.owner))
    system, now = residuals.system(place), residuals.now
    bounds = np.log([(1.0, 1.0, 1.0), _MOST])
    noise = searched.noise
    factors = np.clip(np.log([noise.place, noise.ranges, noise.rays]), bounds[0], bounds[1])

    counted = known
    for number in range(_ROUNDS if shared else 1):
        squared = np.exp(2 * factors)
        if number:
            left = (_LEFT * searched.place) ** 2 * squared[0]
            counted = known & (now**2 < _OUTLIER**2 * (own * squared[[2, 1], None] + left))

        def cost(tried: Floats, counted: Bools = counted) -> float:
            """Return -2 ln of the restricted posterior density of the logarithms (3,) of the factors."""
            squared = np.exp(2 * tried)
            weight = np.where(counted, 1 / (own * squared[[2, 1], None]), 0.0)
            likelihood = system.solve(weight, squared[0])[0] - np.log(weight[counted]).sum()
            return float(likelihood + prior * (2 * tried + 1 / squared)[np.array(unknown)].sum())

        factors, _ = least_cost(cost, np.array(unknown), factors, bounds)
        squared = np.exp(2 * factors)
        now = system.solve(np.where(counted, 1 / (own * squared[[2, 1], None]), 0.0), squared[0])[1]
    return SparseNoise(*np.exp(factors).tolist())


def gain_of_shared_places(searched: Searched) -> float:
    """Return the log odds that all rays of one moment share one error of their place, against a separate error for each
    ray."""
    if not len(searched.found.owner):
        return 0.0
    residuals = _Residuals.of(searched)
    noise = searched.noise
    own = residuals.own * np.array([noise.rays, noise.ranges])[:, None] ** 2
    left = (_LEFT * searched.place * noise.place) ** 2
    weight = np.where(residuals.known & (residuals.now**2 < _OUTLIER**2 * (own + left)), 1 / own, 0.0)
    each = [searched.found.moment, np.arange(len(searched.found.owner))]
    shared, alone = (residuals.system(place).solve(weight, noise.place**2)[0] for place in each)
    return (alone - shared) / 2


@dataclass(frozen=True)
class _Residuals:
    """The residuals of P rays, seen from above. Each array has two rows: the first is across the ray, and the second is
    along it.

    axes: (2, P, 2) the unit vectors. known: (2, P) whether there is a residual. now: (2, P) m, the residuals from the
    corrected places. miss: (2, P) m, the residuals from the given places. own: (2, P) m^2, the variances of the ray and of
    its range in the settings. far: m^2, the prior variance of an object's place.
    """

    searched: Searched
    axes: Floats
    known: Bools
    now: Floats
    miss: Floats
    own: Floats
    far: float

    @classmethod
    def of(cls, searched: Searched) -> _Residuals:
        level = np.maximum(np.hypot(*searched.apart[:, :2].T), MIN_DEPTH)
        flat = np.maximum(np.hypot(*searched.direction[:, :2].T), 1e-6)
        ahead = searched.apart[:, :2] / level[:, None]
        axes = np.stack([np.column_stack([-ahead[:, 1], ahead[:, 0]]), ahead])
        across = level * (searched.direction[:, :2] * axes[0]).sum(axis=1) / flat
        along = searched.range * flat - level
        known = np.stack([np.ones(len(level), dtype=bool), np.isfinite(along)])
        now = np.where(known, [across, along], 0.0)
        miss = now - (axes * searched.shift[:, :2]).sum(axis=2)
        own = np.stack([searched.sigma * level, np.where(known[1], searched.range_sigma, 1.0)]) ** 2
        return cls(searched, axes, known, now, miss, own, (_FAR * level.max(initial=1.0)) ** 2)

    def system(self, place: Ints) -> _System:
        """Return the normal equations. place: (P,) the number of each ray's place. Rays with the same number share an
        error."""
        return _System(self.axes, self.miss, self.searched.found.owner, place, self.searched.place**2, self.far)


class _System:
    """The normal equations for corrections (m) of objects and places, seen from above.

    axes: (2, P, 2) unit vectors across and along each ray. miss: (2, P) m, by how much each ray misses its object. owner,
    place: (P,) the object and the place of each ray. nominal: m^2, the variance of a place at the factor 1. far: m^2, the
    prior variance of an object.
    """

    def __init__(self, axes: Floats, miss: Floats, owner: Ints, place: Ints, nominal: float, far: float) -> None:
        self.axes, self.miss, self.owner, self.nominal, self.far = axes, miss, owner, nominal, far
        _, self.place, number = np.unique(place, return_inverse=True, return_counts=True)
        self.objects, self.places = int(owner.max()) + 1, len(number)
        order, begin = np.argsort(self.place, kind="stable"), np.cumsum(number) - number
        mates = number[self.place[order]]  # Each ray is paired with all rays of its place.
        self.first = np.repeat(order, mates)
        step = np.arange(len(self.first)) - np.repeat(np.cumsum(mates) - mates, mates)
        self.second = order[np.repeat(begin[self.place[order]], mates) + step]

    def solve(self, weight: Floats, factor2: float) -> tuple[float, Floats]:
        """Return -2 ln of the restricted likelihood, and the residuals (2, P), m. The likelihood lacks the terms of the
        rays' own noise.

        weight: (2, P) m^-2, one over the variance of each residual. factor2: the squared factor on the noise of the places.
        """
        prior, eye = self.nominal * factor2, np.eye(2)
        each = np.einsum("ap,api,apj->pij", weight, self.axes, self.axes)
        pull = np.einsum("ap,ap,api->pi", weight, self.miss, self.axes)
        block = grouped_sums(each.reshape(-1, 4), self.place, self.places).reshape(-1, 2, 2) + eye / prior
        inverse, of_place = np.linalg.inv(block), grouped_sums(pull, self.place, self.places)
        own = grouped_sums(each.reshape(-1, 4), self.owner, self.objects).reshape(-1, 2, 2) + eye / self.far
        both = each[self.first] @ inverse[self.place[self.first]] @ each[self.second]
        pair = self.owner[self.first] * self.objects + self.owner[self.second]
        blocks = -grouped_sums(both.reshape(-1, 4), pair, self.objects**2).reshape(self.objects, self.objects, 2, 2)
        blocks[np.arange(self.objects), np.arange(self.objects)] += own
        matrix = blocks.transpose(0, 2, 1, 3).reshape(2 * self.objects, -1)
        through = (inverse @ of_place[:, :, None])[:, :, 0]
        right = grouped_sums(pull - (each @ through[self.place][:, :, None])[:, :, 0], self.owner, self.objects).ravel()
        moved = np.linalg.solve(matrix, right)
        at = moved.reshape(-1, 2)[self.owner]
        carried = grouped_sums((each @ at[:, :, None])[:, :, 0], self.place, self.places)
        errors = (inverse @ (carried - of_place)[:, :, None])[:, :, 0]
        determinants = np.log(np.linalg.det(block)).sum() + np.linalg.slogdet(matrix)[1] + 2 * self.places * np.log(prior)
        squares = (weight * self.miss**2).sum() - (of_place * through).sum() - right @ moved
        return float(squares + determinants), self.miss - (self.axes * (at - errors[self.place])).sum(axis=2)
