"""What is usual among the landmarks of each class: their density, the distances of their boxes, and their sizes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from objslam.association.landmarks import State
from objslam.association.observations import MIN_DEPTH
from objslam.core.arrays import Bools, Floats, Ints
from objslam.core.statistics import NORMAL_MEDIAN, grouped_median, grouped_quantile

_USUAL = 0.9
"""The share of a landmark's boxes that come from within its usual distance. Further away, detections become rare. A larger
share allows landmarks further away."""
_LARGER = 1.4
"""The factor by which a box may be further away than the other boxes of its class. A thing that is larger than others of its
class by half of `_CLASS_SIZE` is detected from further away by this factor. A larger factor allows landmarks further
away."""
_BOXES = 50
"""The least number of boxes of other landmarks with which a class has distances of its own. A class with fewer boxes takes
the distances of all classes. With a larger number, more classes take them."""
_LANDMARKS = 3
"""The least number of landmarks with which a class has a usual distance of its own. A class with fewer landmarks takes the
usual distance of all classes. With a larger number, more classes take it. One wrong landmark of three does not spoil the
median."""
_VIEW_SIZE, _THINGS = 0.25, 5.0
"""`_VIEW_SIZE` is the assumed standard deviation of ln size between two views of one thing. It is the same as `SIZE_SPREAD`
in `observations`. With `_THINGS` landmarks, the measured deviation has the same weight as the assumed one. With a larger
deviation, sizes count less. With a larger number, the assumed deviation counts longer."""
_CLASS_SIZE, _OF_CLASS = 0.7, 3.0
"""`_CLASS_SIZE` is the assumed standard deviation of ln size within a class: sizes differ by a factor of 2. With `_OF_CLASS`
landmarks, the measured deviation has the same weight as the assumed one. With a larger deviation, the size says less about
the distance. With a larger number, the assumed deviation counts longer."""
_LEAST_VIEW = 1e-3
"""The smallest deviation of ln size between views that is used. It keeps the logarithm of the deviation finite."""
_SIZED_BY = 5
"""The least number of boxes that give a landmark a size. A larger number leaves more landmarks without one."""
_MARGIN = (2.0, 2.0, 0.3)
"""The lengths (m) by which the mapped space exceeds the landmarks, along the axes of the map. Larger lengths mean a lower
density of things."""
_INNER = 0.9
"""The share of the landmarks that define how large the mapped space is along each axis. With a larger share, wrong landmarks
far away enlarge it."""


@dataclass(frozen=True)
class UsualViews:
    """What is usual for each of N landmarks, according to the other landmarks of its class.

    state: the landmarks. distance: (N,) m, the distance within which most boxes of the class lie. log_density: (N,) ln of
    the number of things of the class per m^3. ln_size: (R,) ln of the width or of the height of the thing in each box, in m
    per m of its distance. Of both sides, the side with the smaller scatter is used. The value is NaN for a box without a
    size. size: (N,) the median ln size of each landmark, NaN if it has few boxes. view: the standard deviation of ln size
    between views of one thing. class_mean, class_spread: (N,) mean and standard deviation of ln size among the other
    landmarks of the class. If the class has no others, all other landmarks count. The mean is NaN without other landmarks.
    """

    state: State
    distance: Floats
    log_density: Floats
    ln_size: Floats
    size: Floats
    view: float
    class_mean: Floats
    class_spread: Floats

    @classmethod
    def of(cls, state: State, sized: Bools) -> UsualViews:
        """Find what is usual among the landmarks of a state. sized: (R,) whether the camera of each ray observes sizes."""
        count = state.count
        told = sized & (state.obs.size > 0).all(axis=1)
        ln_size = np.log(np.where(told[:, None], state.obs.size, np.nan))
        mine = np.flatnonzero(told[state.assigned])
        owner = state.owner[mine]
        own = ln_size[state.assigned[mine]] + np.log(np.maximum(state.distance[mine], MIN_DEPTH))[:, None]
        middle = grouped_median(own, owner, count)
        scatter = grouped_median(np.abs(own - middle[owner]), owner, count) / NORMAL_MEDIAN
        known = np.bincount(owner, minlength=count) >= _SIZED_BY
        number = int(known.sum())
        found = np.median(scatter[known], axis=0) if number else np.full(2, _VIEW_SIZE)
        weighted = number * np.log(np.maximum(found, _LEAST_VIEW)) + _THINGS * np.log(_VIEW_SIZE)
        view = np.exp(weighted / (number + _THINGS))
        side = int(view.argmin())
        size = np.where(known, middle[:, side], np.nan)
        mean, spread = _of_class(size, state.label)
        return cls(state, _distances(state), _log_density(state), ln_size[:, side], size, view[side], mean, spread)

    def far_odds(self, distance: Floats, landmark: Ints) -> Floats:
        """Return the log likelihood (G,) of the distances of bundles of rays, at most 0. It is relative to a usual distance.

        The boxes of the other landmarks of the class show which distances are usual. distance: (G,) m. landmark: (G,) the
        landmark of each bundle. Its own boxes do not count.
        """
        state, limit = self.state, distance / _LARGER
        label = state.label[state.owner]
        order = np.lexsort((state.distance, label))
        every = np.sort(state.distance)
        boxes = np.bincount(label, minlength=len(state.unassigned))
        own = state.ray_count
        few = (boxes[state.label] - own < _BOXES)[landmark]
        total = np.where(few, len(every), boxes[state.label[landmark]]) - own[landmark]
        beyond = np.empty(len(distance))
        beyond[few] = len(every) - np.searchsorted(every, limit[few])
        ends, away = np.cumsum(boxes), state.distance[order]
        for one in np.unique(state.label[landmark[~few]]).tolist():
            which = np.flatnonzero(~few & (state.label[landmark] == one))
            mine = away[ends[one] - boxes[one] : ends[one]]
            beyond[which] = len(mine) - np.searchsorted(mine, limit[which])
        beyond -= self._own_beyond(limit, landmark)
        return np.minimum(np.log((beyond + 1) / ((1 - _USUAL) * total + 1)), 0.0)

    def _own_beyond(self, limit: Floats, landmark: Ints) -> Ints:
        """Return how many boxes (G,) of each bundle's landmark are further away than a limit (G,) m."""
        state = self.state
        order = np.lexsort((state.distance, state.owner))
        away, owner = state.distance[order], state.owner[order]
        ends = np.cumsum(state.ray_count)
        # One sorted list of all landmarks: those of landmark j lie between j and j + 1.
        scale = 1 + float(max(away.max(initial=0.0), limit.max(initial=0.0)))
        return np.asarray(ends[landmark] - np.searchsorted(owner + away / scale, landmark + limit / scale))


def _distances(state: State) -> Floats:
    """Return the usual distance (N,) m of the class of each landmark. It is the median over the landmarks of the class, or
    over all landmarks if the class has few."""
    own = grouped_quantile(state.distance, state.owner, state.count, _USUAL)
    some = np.flatnonzero(np.isfinite(own))
    if not len(some):
        return np.ones(state.count)
    labels = len(state.unassigned)
    middle, number = grouped_median(own[some], state.label[some], labels), np.bincount(state.label[some], minlength=labels)
    return np.where(number >= _LANDMARKS, middle, np.median(own[some]))[state.label]


def _log_density(state: State) -> Floats:
    """Return ln of the density (N,), m^-3, of landmarks of the class of each landmark. One more landmark is assumed."""
    outer = (1 - _INNER) / 2
    low, high = np.quantile(state.landmarks.position, (outer, 1 - outer), axis=0)
    volume = float(np.prod((high - low) / _INNER + _MARGIN))
    return np.asarray(np.log((np.bincount(state.label)[state.label] + 1) / volume))


def _of_class(size: Floats, label: Ints) -> tuple[Floats, Floats]:
    """Return mean and standard deviation (N,) of ln size (N,) among the other landmarks of each landmark's class.

    Without others in the class, the mean is that of all other landmarks, and the deviation is twice `_CLASS_SIZE`.
    """
    count = len(size)
    mean, spread = np.full(count, np.nan), np.full(count, 2 * _CLASS_SIZE)
    known = np.isfinite(size)
    for j in range(count):
        others = known & (np.arange(count) != j)
        own = others & (label == label[j])
        if own.any():
            mean[j] = np.median(size[own])
            found = np.median(np.abs(size[own] - mean[j])) / NORMAL_MEDIAN
            number = int(own.sum())
            spread[j] = np.sqrt((number * found**2 + _OF_CLASS * _CLASS_SIZE**2) / (number + _OF_CLASS))
        elif others.any():
            mean[j] = np.median(size[others])
    return mean, spread
