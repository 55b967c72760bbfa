"""Estimate how likely a landmark is a static object, from detections, misses, stray rays, sizes and motion. A phantom is a
landmark without an object: rays of different things meet there. A stray ray belongs to no landmark."""

from dataclasses import dataclass, replace

import numpy as np

from objslam.association.gating import gated_edges
from objslam.association.landmarks import State
from objslam.association.refinement import velocity_gain
from objslam.association.visibility import DetectionHistory
from objslam.core.arrays import Bools, Floats, Ints
from objslam.core.statistics import BETWEEN_VISITS, grouped_quantiles, grouped_visits, log_beta, logistic, poisson_tail

_PHANTOM_SHARE = 1 / 8  # The detection rate of a phantom landmark, as a share of the rate of its class.
_CONCENTRATIONS = (3.0, 5.0, 8.0, 13.0, 21.0, 34.0, 55.0)  # The tried concentrations. With larger ones, rates vary less.
_UNUSUAL_SHARE = 0.05
"""The share of objects that are detected more rarely than their class. Neighbours hide such an object on one visit, or one
of its sides is hard to detect. With a larger share, misses drop fewer objects, and more phantoms stay."""
_UNUSUAL_RATE = (0.6, 12.0)
"""The detection rates of objects that are detected more rarely (`_UNUSUAL_SHARE`) have a beta distribution. The first number
is its mean, as a share of the rate of the class: about a half, as for a thing that is hidden on one visit of two. The second
number is its concentration. With a larger mean, misses drop more objects."""
_SHARED_RAYS = 0.5
"""A landmark may be detected more rarely than its class if at most this share of its rays also pass another landmark of the
label. With a larger share, fewer neighbours are dropped, and more phantoms stay."""
_SAME_VIEW = 0.25
"""The largest distance between two places of the camera from which a thing looks alike, as a share of the distance to the
thing. This is a turn of 14 degrees. With a larger share, a wall or a shelf that hides the thing from one of the places is
more often taken for a reason against the thing. No other share was tried."""
_FROM_ELSEWHERE = 0.5
"""The least share of misses that are from other places, for an object that may be hidden from there. A phantom with a box in
every twelfth frame has most misses near its detections. With a larger share, fewer hidden objects are kept. No other
share was tried."""
_VISITS, _BOXES = 2, 3
"""An object may be hidden from other places if it was detected in at least the first number of visits. A visit counts if it
has at least the second number of boxes. Rays to a moving thing meet by chance in one visit, and one or two rays of another
visit pass there too. With larger numbers, fewer hidden objects are kept, and fewer things that move."""
_OFTEN = 0.75
"""The least detection rate of a class whose objects may be hidden from most places, as a share of the rate of all classes.
Things that move are rarely detected where they were. In a simulated warehouse, fork-lifts had 0.6 and people 0.3. With a
larger share, fewer hidden objects are kept."""
_CLEAR_LEAD = 5.0  # A concentration this far below the best, in ln likelihood, is excluded. A larger lead excludes fewer.
_POOLED_BOXES = 100.0  # With this many boxes, a class's own rate weighs as much as the rate of all classes.
_RATE_LIMITS = (0.01, 0.95)  # The limits of a class's rate, because at 0 or 1 a single box or miss would be a proof.
_MOST_PRIOR = 3.0  # The largest prior odds, as for a class with few boxes. A larger value keeps more weak objects.
_EXPECTED_STRAYS = 5.0  # Each class is assumed to have this number of stray boxes in addition to the observed ones.
_LOG_SIZE = 0.7  # The standard deviation of ln size within a class. It is a factor of 2 in size.
_PHANTOM_LOG_RANGE = 4.6  # The width of the uniform ln size distribution of phantoms. It is a factor of 100 in size.
_MOST_ODDS = 20.0  # The largest absolute log odds against chance. This limit only keeps them finite.
_REST_PRIOR = 3.0  # The prior log odds of a static object over a moving one. A larger value drops fewer objects.
_WITHIN_SIZE = 0.5  # The share of an object's size that its apparent motion may have, because box centres wander that far.
_DRIFTED = 2.0  # The largest apparent motion of an object, in sigmas of the path's drift. A larger value drops fewer.
_WITHIN_NOISE = 8.0
"""The largest apparent motion of a thing at rest, in standard deviations of a ray. Poses that err for seconds cause it. In
simulations with pose errors that last 2 s, things at rest seemed to move by up to 8, and walking people by 30. With a larger
number, more things that move become objects."""
_COUNTED_RAYS = 10  # The most rays that count as independent in the motion test.


@dataclass(frozen=True)
class Rates:
    """Beta distributions of the detection rates in each class. mean: (L,) the mean rate of each class. concentration: the
    sum of the two parameters of a distribution, the same for all classes. With several concentrations (C, 1), results get a
    first axis (C,). overall: the mean rate of all classes. untold: (L,) the probability that the rate of a class does not
    tell the rate of one of its objects, so that the object has a rate like the objects of all classes."""

    mean: Floats
    concentration: float | Floats
    overall: float
    untold: Floats | float

    def cost(self, seen: Ints, expected: Ints, label: Ints) -> Floats:
        """Return -2 ln(p) (N,). p is the probability that an object of a label is detected in `seen` of `expected`
        frames."""
        return -2 * _beta_binomial(seen, expected, label, self.mean, self.concentration)

    def log_likelihood(self, history: DetectionHistory, label: Ints) -> float:
        """Return ln of the probability of all detections and misses of objects with these labels (N,)."""
        return float(_beta_binomial(history.seen, history.expected, label, self.mean, self.concentration).sum())

    def log_odds(self, history: DetectionHistory, label: Ints, rarer: Bools | bool = True) -> Floats:
        """Return the log likelihood ratio (N,) of an object of the class over a phantom, from the detections and misses.

        An object has a rate of its class or, with the probability `untold`, a rate of all classes. With the probability
        `_UNUSUAL_SHARE`, its rate is lower. rarer: (N,) whether the rate of each object may be lower.
        """
        phantom, (lower, rarer_concentration) = self.mean * _PHANTOM_SHARE, _UNUSUAL_RATE
        # With the concentration 1 / phantom the density of phantom rates decreases from 0 on.
        rates = np.stack([phantom, self.mean, np.full_like(self.mean, self.overall), lower * self.mean])
        concentrations = np.stack(
            np.broadcast_arrays(1 / phantom, self.concentration, self.concentration, rarer_concentration)
        )
        if concentrations.ndim > rates.ndim:
            rates = rates[:, None]
        of = history.seen, history.expected, label
        as_phantom, of_class, of_all, unusual = _beta_binomial(*of, rates, concentrations)
        untold = np.broadcast_to(self.untold, self.mean.shape)[label]
        with np.errstate(divide="ignore"):  # ln(0) if `untold` is 0 or 1.
            usual = np.logaddexp(np.log1p(-untold) + of_class, np.log(untold) + of_all)
        usual = np.log1p(-_UNUSUAL_SHARE) + usual
        unusual = np.where(rarer, np.log(_UNUSUAL_SHARE), -np.inf) + unusual
        return np.asarray(np.logaddexp(usual, unusual) - as_phantom)


def detection_rates(history: DetectionHistory, label: Ints, labels: int, told: bool = False) -> Rates:
    """Estimate the rate of each class (L,) as the median over its boxes. If a class has few boxes, its rate is near the rate
    of all classes. The concentration is the lowest one whose likelihood is not clearly below the highest likelihood. In this
    likelihood, any object may be a phantom.

    The boxes of one object tell nothing about the differences between objects of its class. So the probability `untold` is
    smaller for a class with more objects. label: (N,) of the objects. labels: the number L of all labels. told: whether the
    rate of a class always tells the rates of its objects, so that `untold` is 0."""
    seen, expected = history.seen.astype(float), history.expected
    own = seen / np.maximum(expected, 1)
    overall = _weighted_median(own, seen, np.zeros(len(seen), dtype=np.int64), 1)
    boxes = np.bincount(label, seen, labels)
    mean = (boxes * _weighted_median(own, seen, label, labels) + _POOLED_BOXES * overall) / (boxes + _POOLED_BOXES)
    untold = 0.0 if told else 1 / np.maximum(np.bincount(label, minlength=labels), 1)
    of_all = float(np.clip(overall[0], *_RATE_LIMITS))
    rates = Rates(np.clip(mean, *_RATE_LIMITS), np.array(_CONCENTRATIONS)[:, None], of_all, untold)
    likelihood = np.logaddexp(0.0, rates.log_odds(history, label)).sum(axis=1)
    return replace(rates, concentration=_CONCENTRATIONS[int(np.argmax(likelihood >= likelihood.max() - _CLEAR_LEAD))])


def _beta_binomial(seen: Ints, expected: Ints, label: Ints, rate: Floats, concentration: float | Floats) -> Floats:
    """Return ln of the probability (..., N) of a sequence of detections and misses, if the rate has a beta distribution.
    label: (N,) the class of each object. rate, concentration: (..., L) the mean rate of each class, and the sum of the two
    parameters.
    """
    a, b = concentration * rate, concentration * (1 - rate)
    counted = [a[..., label] + seen, a], [b[..., label] + expected - seen, b]
    both = log_beta(*(np.concatenate(parts, axis=-1) for parts in counted))
    return both[..., : len(label)] - both[..., len(label) :][..., label]


def _weighted_median(values: Floats, weight: Floats, group: Ints, count: int) -> Floats:
    """Return the weighted median (count,) of each group: half of the weight lies below the median. The median is 0 for a
    group without weight."""
    result = np.zeros(count)
    order = np.lexsort((values, group))
    total = np.cumsum(weight[order])
    upper = np.append(0.0, total)[np.cumsum(np.bincount(group, minlength=count))]
    lower = np.append(0.0, upper[:-1])
    some = upper > lower
    result[some] = values[order][np.searchsorted(total, ((lower + upper) / 2)[some])]
    return result


def existence(state: State, gate: float) -> Floats:
    """Return the probability (N,) that each landmark is a static object."""
    return np.asarray(logistic(static_odds(state, gate)) * logistic(chance_odds(state, gate)))


def rates_of_classes(state: State) -> Rates:
    """Return the `detection_rates` of the landmarks of a state. With a localisation, the rate of a class always tells the
    rate of its objects, because they may be detected more rarely anyway (`rarer_objects`)."""
    return detection_rates(state.history, state.label, len(state.unassigned), state.view.localized)


def static_odds(state: State, gate: float, fitted: int = 0) -> Floats:
    """Return the log odds (N,) of a static object over a phantom or a moving thing, from detections, misses, sizes and
    motion. gate: see `rarer_objects`. fitted: see `rest_odds`."""
    return np.asarray(rate_odds(state, gate) + size_odds(state) + rest_odds(state, fitted))


def rate_odds(state: State, gate: float) -> Floats:
    """Return the log odds (N,) of an object over a phantom, from the numbers of boxes, the detections and the misses.

    Walls, shelves and table tops have no boxes, but they hide an object from most places. So an object that may be detected
    more rarely than its class (`rarer_objects`) may also be hidden from some places. Then only frames from places near the
    places of its detections count. gate: see `rarer_objects`.
    """
    rates, prior = rates_of_classes(state), prior_odds(state)
    rarer = rarer_objects(state, rates, gate)
    odds = rates.log_odds(state.history, state.label, rarer) + prior
    often = (rates.mean >= _OFTEN * rates.overall)[state.label]
    hidden, history = _hidden_elsewhere(state, np.flatnonzero(rarer & often & (odds < 0)))
    if len(hidden):
        as_hidden = rates.log_odds(history, state.label[hidden], False) + prior[hidden]
        odds[hidden] = np.logaddexp(odds[hidden], np.log(_UNUSUAL_SHARE) + as_hidden)
    return odds


def _hidden_elsewhere(state: State, landmarks: Ints) -> tuple[Ints, DetectionHistory]:
    """Return those of some landmarks (n,) that may be hidden from most places. Also return their history from places near
    those of their detections.

    Most misses of such a landmark are from other places (`_FROM_ELSEWHERE`), and it was detected in several visits
    (`_VISITS`).
    """
    history, camera = state.history, state.view.map_T_camera[:, :2, 3]
    bounds = np.searchsorted(history.object, np.append(landmarks, landmarks + 1)).reshape(2, -1).T
    visit = grouped_visits(state.view.stamps[state.obs.frame[state.assigned]], state.owner, BETWEEN_VISITS)
    _, first, boxes = np.unique(visit, return_index=True, return_counts=True)
    visits = np.bincount(state.owner[first[boxes >= _BOXES]], minlength=state.count)
    hidden, kept = list[int](), list[Ints]()
    for j, (begin, end) in zip(landmarks.tolist(), bounds.tolist(), strict=True):
        if visits[j] < _VISITS:
            continue
        frame, detected = history.frame[begin:end], history.detected[begin:end]
        places, place = camera[frame], state.landmarks.position[j, :2]
        near = looks_alike(places, detected, place)
        if (near & ~detected).sum() <= (1 - _FROM_ELSEWHERE) * (~detected).sum():
            hidden.append(j)
            kept.append(begin + np.flatnonzero(near))
    rows = np.concatenate([np.zeros(0, dtype=np.int64), *kept])
    owner = np.repeat(np.arange(len(kept)), [len(one) for one in kept])
    of = np.array(hidden, dtype=np.int64)
    return of, DetectionHistory(owner, history.frame[rows], history.detected[rows], history.inside[of])


def looks_alike(places: Floats, detected: Bools, thing: Floats) -> Bools:
    """Return from which camera places (n, 2) m a thing at a place (2,) m looks about as it did in its detections.

    detected: (n,) from which camera places the thing was detected, at least one.
    """
    from scipy.spatial import cKDTree  # It takes long to load, and few logs need it.

    nearest = cKDTree(places[detected]).query(places)[0]
    return np.asarray(nearest <= _SAME_VIEW * np.linalg.norm(places - thing, axis=1))


def rarer_objects(state: State, rates: Rates, gate: float) -> Bools:
    """Return which landmarks (N,) may be objects that are detected more rarely than their class.

    The rays of a phantom belong to other things. So a landmark whose rays also pass other landmarks within the gate (a
    squared deviation) must be detected as often as its class. With odometry alone, each landmark must be detected that
    often. Where the path is wrong, the rays of a known thing miss it and may meet elsewhere. Only misses then show that this
    landmark is a phantom.
    """
    if not state.view.localized:
        return np.zeros(state.count, dtype=bool)
    rarer = np.ones(state.count, dtype=bool)
    usual = rates.log_odds(state.history, state.label, False)
    asked = usual + prior_odds(state) < 0
    if asked.any():
        rays = np.flatnonzero(np.append(asked, False)[state.matched])
        edges = gated_edges(state.obs.take(rays), state.landmarks, gate)
        own = state.matched[rays]
        shared = np.zeros(len(rays), dtype=bool)
        shared[edges.ray[edges.landmark != own[edges.ray]]] = True
        rarer = np.bincount(own, shared, state.count) <= _SHARED_RAYS * state.ray_count
    return rarer


def chance_odds(state: State, gate: float) -> Floats:
    """Return the log odds (N,) that the rays of each landmark do not meet by chance.

    Any two stray rays of a class define a point. The number of further strays in the gate of the point is Poisson
    distributed. Strays are the rays without a landmark, and the rays of landmarks with no more rays than this one.
    """
    return _odds_of_share(state, stray_share(state, gate))


def beyond_chance(state: State, gate: float, least: float) -> Bools:
    """Return which landmarks (N,) have `chance_odds` of at least a value.

    The odds of a landmark are lower if more frames look at it. If the odds are high enough even with all frames, the frames
    that look at the landmark are not determined. To determine them takes most of the time.
    """
    surely = _odds_of_share(state, _gate_area(state, gate) / (state.view.solid_angle * state.obs.scale)) >= least
    return surely if surely.all() else chance_odds(state, gate) >= least


def _odds_of_share(state: State, share: Floats) -> Floats:
    """Return `chance_odds` (N,). share: (N,) as `stray_share` returns it."""
    strays = _no_stronger(state.ray_count, state.label) + state.unassigned[state.label]
    points = np.log(np.maximum(strays * (strays - 1) / 2, 1.0))
    chance = np.log(np.maximum(poisson_tail(state.ray_count - 2, strays * share), 1e-300))
    return np.clip(-points - chance, -_MOST_ODDS, _MOST_ODDS)


def prior_odds(state: State) -> Floats:
    """Return the prior log odds (N,) of an object, from the numbers of assigned and unassigned boxes of its class."""
    odds = np.log((state.label_count.sum(axis=0) + _EXPECTED_STRAYS * _MOST_PRIOR) / (state.unassigned + _EXPECTED_STRAYS))
    return np.minimum(odds, np.log(_MOST_PRIOR))[state.label]


def stray_share(state: State, gate: float) -> Floats:
    """Return the share (N,) of boxes at random pixels of the images whose rays would pass each landmark within its gate."""
    looks = np.maximum(state.history.inside, state.history.expected) / max(len(state.view.camera), 1)
    return looks * _gate_area(state, gate) / (state.view.solid_angle * state.obs.scale)


def _gate_area(state: State, gate: float) -> Floats:
    """Return the mean solid angle (N,), in sr, within the gates of each landmark's rays."""
    angle2 = state.variance / np.maximum(state.distance, 1e-3) ** 2
    return np.asarray(np.pi * gate * np.bincount(state.owner, angle2, state.count) / np.maximum(state.ray_count, 1))


def size_odds(state: State) -> Floats:
    """Return the log odds (N,), at most 0, of an object of the class over a phantom, from the landmark's size.

    Crossing rays of different objects give a wrong distance, and so a wrong size.
    """
    own = np.log(np.maximum(state.size, 1e-6))
    usual = _weighted_median(own, state.ray_count.astype(float), state.label, len(state.unassigned))[state.label]
    as_object = -0.5 * ((own - usual) / _LOG_SIZE) ** 2 - np.log(_LOG_SIZE * np.sqrt(2 * np.pi))
    return np.asarray(np.minimum(as_object + np.log(_PHANTOM_LOG_RANGE), 0.0))


def _no_stronger(number: Ints, label: Ints) -> Ints:
    """Return for each landmark the sum (N,) of the rays of all landmarks of its class with at most as many rays."""
    rank = label * (int(number.max(initial=0)) + 1) + number
    order = np.argsort(rank)
    total = np.append(0, np.cumsum(number[order]))
    first, last = np.searchsorted(label[order], label), np.searchsorted(rank[order], rank, side="right")
    return np.asarray(total[last] - total[first])


def rest_odds(state: State, fitted: int = 0) -> Floats:
    """Return the log odds (N,), at most 0, of a static point over a point with constant velocity.

    Rays of a slow object may meet for a while, but a moving point explains them much better. BIC gives the odds from the
    share of the squared deviations that a velocity explains. Errors of poses last for seconds, so they also look like a
    motion. If these errors can explain the distance that the point moved, only the part of the deviations beyond their
    nominal noise counts. A box centre wanders over its object as the view changes, which also looks like motion. So only a
    few rays count. Motion within the size of the object, or within the drift of the path, does not count. fitted: the number
    of measured coordinates that a moving point explains even by chance. This number matters if there are few rays.
    """
    obs, landmarks = state.obs, state.landmarks
    stamps = state.view.stamps[obs.frame[state.assigned]]
    explained, way = velocity_gain(obs, state.assigned, state.owner, landmarks.position, landmarks.noise, stamps)
    size = 2.0 * np.clip(state.ray_count, 1, _COUNTED_RAYS)  # Each ray measures two coordinates.
    left = np.clip(2.0 * state.ray_count - fitted, 0.0, size)
    each = np.bincount(state.owner, state.deviation**2, state.count) / np.maximum(2 * state.ray_count, 1)
    gain = -np.log(np.clip(1 - explained, 1e-6, 1.0))
    gain = np.where(way > _WITHIN_NOISE * state.ray_sigma, gain, np.minimum(gain, each * explained))
    odds = _REST_PRIOR + 1.5 * np.log(size) - 0.5 * left * gain
    allowed = np.maximum(_WITHIN_SIZE * state.size, _DRIFTED * _drift_at(state))
    return np.where(way > allowed, np.minimum(odds, 0.0), 0.0)


def _drift_at(state: State) -> Floats:
    """Return the standard deviation (N,) m of the path's drift at each landmark, from its first ray to its last.

    The drift between two frames is a small rotation and shift (phi, rho) in map. It moves a point p by rho + phi x p.
    """
    drift = state.view.drift
    if drift is None or not state.count:
        return np.zeros(state.count)
    ends = grouped_quantiles(state.obs.frame[state.assigned].astype(np.float64), state.owner, state.count, (0.0, 1.0))
    first, last = (np.nan_to_num(frame).astype(np.int64) for frame in ends)
    p = state.landmarks.position
    turns = np.cross(np.eye(3), p[:, None])  # Row i is e_i x p, the way of p per angle about axis i.
    moves = np.concatenate([turns, np.broadcast_to(np.eye(3), (len(p), 3, 3))], axis=1)
    covariance = drift[last] - drift[first]
    return np.sqrt(np.maximum(np.einsum("nai,nab,nbi->n", moves, covariance, moves), 0.0))
