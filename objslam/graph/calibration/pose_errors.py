"""Describe the errors of localised poses by models, and find the model that agrees best with predicted poses."""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.linalg.lapack import dpotrf, dtrtrs

from objslam.core.arrays import Floats, Ints
from objslam.core.noise import MOST_NOISE, MOST_POSE_NOISE
from objslam.core.statistics import WHITE, Lasting

_TIMES = tuple(2.0**k for k in range(8))
"""The tried times (s) for which errors last. Errors of a shorter time hardly differ from new errors in each pose, and errors
of a longer time from a shift of the whole map. More times are more exact and slower."""
_FINE = np.geomspace(_TIMES[0], _TIMES[-1], 200)
"""The times (s) of the table in which the time of an averaged error is interpolated. `_TIMES` are too coarse for this. More
times are more exact."""
_SHARES = (0.0, 0.1, 0.3, 0.5, 0.7, 0.85, 0.95, 0.99, 1.0)
"""The tried shares of an error's variance that last. More shares are more exact and slower."""
_STEPS = (0.8, 0.3, 0.1)
"""The steps of the search for factors on noise, in logarithms. A smaller last step is more exact and slower."""
_BOTH = ("heading", "place")
"""The names of the two errors of a pose."""
_SIZES = (-1.5, 0.0, 1.0, 2.0, 3.0)
"""The logarithms of the factors on noise that are tried as starts of a search. More starts are slower."""
_AROUND = np.array([-1.2, -0.8, -0.4, -0.2, 0.0, 0.2, 0.4, 0.6, 0.8, 1.2])
"""The logarithms of the factors, relative to the most likely one, over which the variance of a lasting error is averaged.
They reach far, because a short log may agree with two quite different sizes. More factors are more exact and slower."""
_USUAL = 1.0
"""The prior standard deviation of the logarithm of a factor on noise, for factors above 1. In a short log, an error of usual
size looks like one twice as large that lasts four times as long. A larger value makes the larger error more likely."""
_LEAST_FACTOR, _MOST_FACTOR = np.log(0.05), np.log(MOST_POSE_NOISE)
"""The bounds of the logarithm of a factor on noise. A localisation may be far better than the settings say. If small factors
were not allowed, its small differences from pose to pose would look like errors that last."""
_PREDICTED = (np.log(0.3), np.log(MOST_NOISE))
"""The bounds of the logarithm of the factor on the error of the prediction. This noise may be unknown too."""
_CHANCE = 1e-3
"""The chance of a false alarm: a localisation that is as good as the settings say is found worse. With a larger chance,
shorter logs can show more noise, and more good logs seem to have more noise."""
_SIGNIFICANT = -2 * np.log(_CHANCE)
"""The decrease of -2 ln of the likelihood from which on noise beyond the settings, or a lasting part, counts. Chi-squared
with 2 degrees of freedom exceeds this value with the probability `_CHANCE`."""


@dataclass(frozen=True)
class ErrorKind:
    """The error of headings, or of places. factor: the logarithm of the factor on its noise. share, time: the indices of the
    share in `_SHARES` and of the time in `_TIMES` that describe its lasting part."""

    factor: float = 0.0
    share: int = 0
    time: int = 3

    @property
    def lasting(self) -> Lasting:
        """The lasting part of the error."""
        return Lasting(_SHARES[self.share], _TIMES[self.time]) if self.share else WHITE


@dataclass(frozen=True)
class PoseErrors:
    """A model of the errors of a pose. predicted: the logarithm of the factor on the error of the prediction."""

    heading: ErrorKind = ErrorKind()
    place: ErrorKind = ErrorKind()
    predicted: float = 0.0


@dataclass(frozen=True)
class ComparedPoses:
    """n poses of the localisation and their prediction.

    off: (3 n,) headings (rad), x and y (m), prediction minus localisation. covariance: (3 n, 3 n) of `off` by the noise of
    the prediction. shared: (3 n, 3 n) of `off` by the shared errors, and by the odometry that carried the localisation to
    the poses. No factor multiplies it. times: (n,) s. apart: s, the time between poses that were measured independently, 0
    if all were. nominal: the noise of headings, rad, and places, m, in the settings. free: whether the size of the noise is
    unknown. prior: the weight of the nominal noise of the prediction, as a number of residuals.
    """

    off: Floats
    covariance: Floats
    shared: Floats
    times: Floats
    apart: float
    nominal: tuple[float, float]
    free: bool
    prior: float

    def take(self, poses: Ints) -> "ComparedPoses":
        """Return the data of some poses."""
        n = len(self.times)
        at = np.concatenate([poses, n + poses, 2 * n + poses])
        some = np.ix_(at, at)
        return replace(
            self, off=self.off[at], covariance=self.covariance[some], shared=self.shared[some], times=self.times[poses]
        )

    @cached_property
    def gaps(self) -> Floats:
        """(n, n) s, the times between poses."""
        return np.abs(self.times[:, None] - self.times)

    @cached_property
    def white(self) -> Floats:
        """(n, n) the correlations of errors that are new in each measured pose."""
        return np.maximum(1 - self.gaps / self.apart, 0.0) if self.apart else np.eye(len(self.times))

    @cached_property
    def alike(self) -> Floats:
        """(m, n, n) the correlations of errors that last for a time, for each of the m `_TIMES`."""
        return np.exp(-self.gaps / np.array(_TIMES)[:, None, None])

    def expected(self, model: PoseErrors) -> Floats:
        """Return the covariance (3 n, 3 n) of `off` in a model."""
        n, found = len(self.times), self.by_prediction(model.predicted).copy()
        for first, kind, nominal in ((0, model.heading, self.nominal[0]), (1, model.place, self.nominal[1])):
            own = self._own(kind, nominal)
            for part in (0,) if first == 0 else (1, 2):
                found[part * n : (part + 1) * n, part * n : (part + 1) * n] += own
        return found

    def _own(self, kind: ErrorKind, nominal: float) -> Floats:
        """Return the covariance (n, n), rad^2 or m^2, of errors of n headings or places. nominal: their sigma, rad or m."""
        variance, lasting = (nominal * np.exp(kind.factor)) ** 2, kind.lasting
        own = variance * (1 - lasting.share) * self.white
        return own + variance * lasting.share * self.alike[kind.time] if lasting.share else own

    def by_prediction(self, predicted: float) -> Floats:
        """Return the covariance (3 n, 3 n) of `off` without the localisation's own error. The last result is kept."""
        if predicted not in self._predicted:
            self._predicted.clear()
            self._predicted[predicted] = np.exp(2 * predicted) * self.covariance + self.shared
        return self._predicted[predicted]

    @cached_property
    def _predicted(self) -> dict[float, Floats]:
        return {}

    @cached_property
    def _costs(self) -> dict[PoseErrors, float]:
        return {}

    @cached_property
    def _placed(self) -> dict[tuple[ErrorKind, float], "_Placed | None"]:
        return {}

    def cost(self, model: PoseErrors) -> float:
        """Return -2 ln of the likelihood, with the priors of the factors on the noise.

        Costs are kept, because the searches come back to the same models. This takes a quarter less time. The parts of the
        places alone (`_Placed`) are also kept, because a third of the models differ in headings only. This takes a further
        third less.
        """
        if model not in self._costs:
            self._costs[model] = self._cost(model)
        return self._costs[model]

    def _cost(self, model: PoseErrors) -> float:
        key = model.place, model.predicted
        if key not in self._placed:
            own = self._own(model.place, self.nominal[1])
            self._placed[key] = _Placed.of(self.by_prediction(model.predicted), own, self.off)
        placed = self._placed[key]
        if placed is None:
            return np.inf
        root, failed = dpotrf((placed.left + self._own(model.heading, self.nominal[0])).T, lower=1, clean=0, overwrite_a=1)
        if failed:
            return np.inf
        white, _ = dtrtrs(root, placed.off, lower=1)
        prior = self.prior * (2 * model.predicted + np.exp(-2 * model.predicted))
        prior += sum(max(kind.factor / _USUAL, 0.0) ** 2 for kind in (model.heading, model.place))
        return float(placed.cost + white @ white + 2 * np.log(np.diagonal(root)).sum() + prior)


@dataclass(frozen=True)
class _Placed:
    """The likelihood of the places of n poses, and the headings given these places.

    cost: -2 ln of the likelihood of the places. off: (n,) rad, the headings minus the headings that follow from the places.
    left: (n, n) the covariance of `off` without the error of the headings themselves.
    """

    cost: float
    off: Floats
    left: Floats

    @classmethod
    def of(cls, covariance: Floats, own: Floats, off: Floats) -> "_Placed | None":
        """Return the likelihood. None if the covariance (3 n, 3 n) of `off` (3 n,), headings first, is singular.

        own: (n, n) the localisation's own covariance for each axis of the places, which is not yet in `covariance`.
        """
        n = len(off) // 3
        places = covariance[n:, n:].copy()
        places[:n, :n] += own
        places[n:, n:] += own
        # LAPACK reads columns. A symmetric matrix is its own transpose, and the transpose of rows needs no copy.
        root, failed = dpotrf(places.T, lower=1, clean=0, overwrite_a=1)
        if failed:
            return None
        told, _ = dtrtrs(root, np.vstack([off[n:], covariance[:n, n:]]).T, lower=1, overwrite_b=1)
        white, by_heading = told[:, 0], told[:, 1:]
        cost = white @ white + 2 * np.log(np.diagonal(root)).sum()
        return cls(float(cost), off[:n] - by_heading.T @ white, covariance[:n, :n] - by_heading.T @ by_heading)


def most_likely(data: ComparedPoses, near: PoseErrors | None = None) -> PoseErrors:
    """Return the simplest model that the data do not refute. From the simplest on, the models have the noise in the
    settings, more noise, one lasting part for headings and places, and a lasting part for each of the two.

    If places err for seconds, headings probably do too, because both come from one filter. A short log may not show this.
    near: the model of nearly the same data, if known. It saves most of the search for errors that last.
    """
    most = _MOST_FACTOR if data.free else 0.0
    usual, cost_usual = _searched(data, _begun(data, PoseErrors(), 0.0), 0.0, ())
    # A search may end at too large a prediction error. So another search begins at the factor 1 on this error.
    begun = {_begun(data, replace(usual, predicted=predicted), most) for predicted in (0.0, usual.predicted)}
    best, least = min((_searched(data, start, most, ()) for start in begun), key=lambda found: found[1])
    if near is not None and near.heading.share and near.place.share:
        lasting, cost = _searched(data, near, most, (_BOTH,))
    else:
        lasting, cost = _lasting(data, most)
    apart, cost_apart = _searched(data, lasting, most, tuple((one,) for one in _BOTH))
    if cost < least - _SIGNIFICANT:
        best, least = lasting, cost
    if cost_apart < least - _SIGNIFICANT:
        best, least = apart, cost_apart
    return best if least < cost_usual - _SIGNIFICANT else usual


def averaged(data: ComparedPoses, model: PoseErrors) -> tuple[tuple[float, Lasting], tuple[float, Lasting]]:
    """Return the factor on the noise and the lasting part of headings and of places. Errors that last are averaged.

    A log contains few independent samples of an error that lasts. The most likely values would make the noise too small. So
    the variance of the error, and the variance of its mean over the log, are averaged over the posterior. The time is the
    one with the averaged variance of the mean.
    """
    duration = float(np.ptp(data.times))
    found = dict[str, tuple[float, Lasting]]()
    for name in _BOTH:
        kind = getattr(model, name)
        if not kind.share:
            found[name] = max(float(np.exp(kind.factor)), 1.0), WHITE
            continue
        factors = np.clip(kind.factor + _AROUND, _LEAST_FACTOR, _MOST_FACTOR if data.free else 0.0)
        tried = [
            [data.cost(_with(model, name, replace(kind, factor=f, time=t))) for t in range(len(_TIMES))]
            for f in factors.tolist()
        ]
        weight = np.exp(-(np.array(tried) - np.min(tried)) / 2) * np.gradient(_AROUND)[:, None]
        weight /= weight.sum()
        variance = weight * np.exp(2 * factors)[:, None]
        of_mean = float((variance * _variance_of_mean(np.array(_TIMES), duration)).sum() / variance.sum())
        seconds = float(np.interp(of_mean, _variance_of_mean(_FINE, duration), _FINE))
        total = float(variance.sum())
        # Poses count as no better than the settings say. If they are better, the rest of the nominal noise is white.
        found[name] = max(float(np.sqrt(total)), 1.0), Lasting(_SHARES[kind.share] * min(total, 1.0), seconds)
    return found["heading"], found["place"]


def _variance_of_mean(seconds: Floats, duration: float) -> Floats:
    """Return the variances of the mean over `duration`, s, of errors of variance 1 that last for `seconds` (n,), s."""
    share = seconds / max(duration, 1e-9)
    return np.asarray(2 * share * (1 - share * (1 - np.exp(-1 / share))))


def _with(model: PoseErrors, name: str, kind: ErrorKind) -> PoseErrors:
    """Return a model in which `kind` replaces the error of this name."""
    return replace(model, heading=kind) if name == "heading" else replace(model, place=kind)


def _with_lasting(model: PoseErrors, names: tuple[str, ...], share: int, time: int) -> PoseErrors:
    """Return a model in which the errors of these names have this lasting part."""
    for name in names:
        model = _with(model, name, replace(getattr(model, name), share=share, time=time))
    return model


def _begun(data: ComparedPoses, model: PoseErrors, most: float) -> PoseErrors:
    """Return the best of a few models without lasting errors. The logarithms of their factors are at most `most`, and their
    prediction has the error of `model`."""
    sizes = [size for size in _SIZES if size <= most]
    tried = [replace(model, heading=ErrorKind(heading), place=ErrorKind(place)) for heading in sizes for place in sizes]
    return min(tried, key=data.cost)


def _lasting(data: ComparedPoses, most: float) -> tuple[PoseErrors, float]:
    """Return the model with the least cost in which both errors last, and this cost.

    The searches begin at four times, with the noise in the settings. They do not begin at the best white errors. Those are
    far too small, because the drifting prediction takes up most of a lasting error, and a search from there ends there. All
    searches take long steps, and the best two go on with short ones.
    """
    begun = [_with_lasting(PoseErrors(), _BOTH, len(_SHARES) - 1, time) for time in (1, 3, 5, 7)]
    rough = sorted((_searched(data, start, most, (_BOTH,), _STEPS[:1]) for start in begun), key=lambda found: found[1])
    return min((_searched(data, start, most, (_BOTH,)) for start, _ in rough[:2]), key=lambda found: found[1])


def _searched(
    data: ComparedPoses,
    start: PoseErrors,
    most: float,
    lasting: tuple[tuple[str, ...], ...],
    steps: tuple[float, ...] = _STEPS,
) -> tuple[PoseErrors, float]:
    """Return the model with the least cost, and this cost. The search takes steps along the axes, from large to small.

    most: the largest logarithm of a factor on noise. lasting: groups of errors whose lasting part changes. The errors of a
    group share one lasting part. steps: the steps of factors, in logarithms.
    """
    best, cost = start, data.cost(start)
    for step in steps:
        moved = True
        while moved:
            moved = False
            for other in _moves(best, most, lasting, step):
                if (tried := data.cost(other)) < cost - 1e-6:
                    best, cost, moved = other, tried, True
    return best, cost


def _moves(model: PoseErrors, most: float, lasting: tuple[tuple[str, ...], ...], step: float) -> list[PoseErrors]:
    """Return the neighbours of a model. most, lasting: as in `_searched`."""
    found = []
    for sign in (1, -1):
        found.append(replace(model, predicted=_stepped(model.predicted, sign * step, *_PREDICTED)))
        for name in _BOTH:
            kind = getattr(model, name)
            factor = _stepped(kind.factor, sign * step, _LEAST_FACTOR, most)
            found.append(_with(model, name, replace(kind, factor=factor)))
        for names in lasting:
            kind = getattr(model, names[0])
            share = int(np.clip(kind.share + sign, 0, len(_SHARES) - 1))
            time = int(np.clip(kind.time + sign, 0, len(_TIMES) - 1))
            found.append(_with_lasting(model, names, share, kind.time))
            longer = _with_lasting(model, names, kind.share, time)
            found.append(longer)
            # An error twice as large that lasts four times as long looks the same from pose to pose.
            larger = np.log(_TIMES[time] / _TIMES[kind.time]) / 2
            for name in names:
                one = getattr(longer, name)
                longer = _with(longer, name, replace(one, factor=_stepped(one.factor, larger, _LEAST_FACTOR, most)))
            found.append(longer)
    return [one for one in found if one != model]


def _stepped(value: float, step: float, least: float, most: float) -> float:
    """Return a value after a step, within bounds. It is rounded, so that a step back gives the same model."""
    return round(float(np.clip(value + step, least, most)), 9)
