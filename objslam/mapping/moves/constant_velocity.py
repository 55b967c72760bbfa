"""Fit points at rest, and points with a constant velocity, to the rays and ranges of views that last for seconds."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from objslam.core.arrays import Floats, Ints
from objslam.core.geometry import lengths
from objslam.core.rotation import cross
from objslam.core.statistics import CAUCHY_K, NORMAL_MEDIAN, grouped_median, grouped_quantile, grouped_sums

FEWEST = 3
"""The fewest ranges of a view that is judged. Two ranges always follow a trend. With a larger number, fewer objects are
judged."""
_GAP = 2.0
"""The longest time (s) between two consecutive rays of a visit. A detector may miss a thing for a second. With a longer
time, separate visits count as one."""
_LONGEST = 4.0
"""The longest duration (s) of a view. People keep their velocity for some seconds. With a longer duration, slower motions
show, but the motions of people who turn do not."""
_PRIOR = 4.0
"""The weight of the noise of all labels in the noise of one label, as a number of ranges. With a larger number, labels
differ less."""
_LEAST_NOISE = 0.1
"""The least noise of ranges, as a factor on their nominal noise. Simulated depths may have no noise. With a larger factor,
fewer moving things are found."""
_FASTEST = 10.0
"""The prior standard deviation (m/s) of a velocity. It only keeps a fit finite. A larger value changes hardly anything."""
_FAR = 100.0
"""The prior standard deviation (m) of the place of a point about its object. It only keeps a fit finite. A larger value
changes hardly anything."""
_LEAST_BIAS = 1e-3
"""The least standard deviation (m) of the error that the ranges of a view share. With a larger value, ranges that contradict
the rays matter less."""
_UNKNOWN_WIDTH = 0.5
"""The assumed width (m) of things whose boxes show no size. With a larger width, fewer moving things are found."""
_ROUNDS = 4
"""The number of fits with robust weights. After four fits, the weights hardly change. A larger number takes longer."""


@dataclass(frozen=True)
class Sights:
    """The P rays and ranges of N things.

    thing: (P,) the number of each ray's thing. time: (P,) s. origin: (P, 3) m. direction: (P, 3) unit vectors. across: (P,)
    m, the noise of a ray at the distance of its thing. range: (P,) m, NaN if unknown. nominal: (P,) m, the noise of the
    range, up to a factor for each label. bias: (P,) m, the standard deviation of the error that the ranges of a thing share.
    half: (P,) half the width of the thing, in m per m of its distance. place: (N, 3) m, the position of each thing. label:
    (N,) the label of each thing.
    """

    thing: Ints
    time: Floats
    origin: Floats
    direction: Floats
    across: Floats
    range: Floats
    nominal: Floats
    bias: Floats
    half: Floats
    place: Floats
    label: Ints


@dataclass(frozen=True)
class Views:
    """V views of things. A view has the rays to a thing that follow each other within seconds.

    sights: all rays, sorted by view. view: (P,) the view of each ray. time: (P,) s, of each ray, from the mean time of its
    view. thing, label: (V,) the thing of each view, and the label of this thing. visit: (V,) the number of each view's
    visit. A visit has the views of a thing without a long gap between them. rays, number: (V,) the numbers of rays and of
    ranges of a view. bias: (V,) m, the mean `bias` of the ranges. seconds: (V,) s, from the first ray of a view to the last.
    width: (V,) m, the largest width of the thing.
    """

    sights: Sights
    view: Ints
    time: Floats
    thing: Ints
    label: Ints
    visit: Ints
    rays: Ints
    number: Ints
    bias: Floats
    seconds: Floats
    width: Floats

    @classmethod
    def of(cls, sights: Sights) -> Views:
        """Return the views of things. sights: at least one ray."""
        order = np.lexsort((sights.time, sights.thing))
        rows = ("thing", "time", "origin", "direction", "across", "range", "nominal", "bias", "half")
        sights = Sights(**{name: getattr(sights, name)[order] for name in rows}, place=sights.place, label=sights.label)
        thing, time = sights.thing, sights.time
        begins = np.append(True, (np.diff(thing) != 0) | (np.diff(time) > _GAP))
        visit = np.cumsum(begins) - 1
        piece = np.floor((time - time[begins][visit]) / _LONGEST)
        begins[1:] |= np.diff(piece) != 0
        view, of = np.cumsum(begins) - 1, thing[begins]
        rays, known = np.bincount(view), np.isfinite(sights.range)
        wide = 2 * sights.half * np.where(known, sights.range, lengths(sights.place[thing] - sights.origin))
        own = np.nan_to_num(grouped_quantile(wide, thing, len(sights.label), 1.0))
        seen = np.unique(thing)
        usual = grouped_median(own[seen], sights.label[seen], int(sights.label.max()) + 1)
        width = np.maximum(own[of], usual[sights.label[of]])
        return cls(
            sights=sights,
            view=view,
            time=time - (np.bincount(view, time) / rays)[view],
            thing=of,
            label=sights.label[of],
            visit=visit[begins],
            rays=rays,
            number=np.bincount(view, known),
            bias=np.bincount(view, np.where(known, sights.bias, 0.0)) / np.maximum(np.bincount(view, known), 1),
            seconds=time[np.append(begins[1:], True)] - time[begins],
            width=np.where(width > 0, width, _UNKNOWN_WIDTH),
        )


@dataclass(frozen=True)
class PointFit:
    """The fit of a point to each of V views. cost: (V,) -2 ln of the likelihood, up to a constant. along: (V,) the part of
    the cost from the ranges. speed: (V,) m/s, the point's velocity away from the robot. variance: (V,) m^2/s^2, the variance
    of this speed. off: (P,) m, the residuals of the ranges."""

    cost: Floats
    along: Floats
    speed: Floats
    variance: Floats
    off: Floats


def fit_point(views: Views, level: Floats, *, moving: bool) -> PointFit:
    """Fit a point to the rays and ranges of each view, with a constant velocity or at rest.

    Cauchy's loss bounds the influence of wrong ranges. The ranges of a view share an error. level: (V,) the factor on the
    nominal noise of ranges. moving: whether the points have a velocity.
    """
    sights, view, count, unknown = views.sights, views.view, len(views.thing), 7 if moving else 4
    to = sights.place[sights.thing] - sights.origin
    steady = np.where(np.abs(sights.direction[:, 2:]) < 0.9, [[0.0, 0.0, 1.0]], [[1.0, 0.0, 0.0]])
    side = cross(steady, sights.direction)
    side /= lengths(side)[:, None]
    axes = np.stack([side, cross(sights.direction, side), sights.direction], axis=1)  # (P, 3, 3), a row for each residual.
    wanted = -np.einsum("nij,nj->ni", axes, to)
    known = np.isfinite(sights.range)
    wanted[:, 2] += np.where(known, sights.range, 0.0)
    shared = np.zeros((len(view), 3, 1))
    shared[:, 2] = 1.0
    columns = [axes, shared, axes * views.time[:, None, None]] if moving else [axes, shared]
    slopes = np.concatenate(columns, axis=2)
    weight = np.stack([sights.across, sights.across, sights.nominal * level[view]], axis=1) ** -2
    weight[:, 2] = np.where(known, weight[:, 2], 0.0)
    prior = np.zeros((count, unknown))
    prior[:, :3], prior[:, 4:] = _FAR**-2, _FASTEST**-2
    prior[:, 3] = np.maximum(views.bias, _LEAST_BIAS) ** -2
    robust = np.ones(len(view))
    for _ in range(_ROUNDS):
        now = np.column_stack([weight[:, :2], weight[:, 2] * robust])
        products = np.einsum("nri,nr,nrj->nij", slopes, now, slopes).reshape(len(view), -1)
        normal = grouped_sums(products, view, count).reshape(count, unknown, unknown) + prior[:, :, None] * np.eye(unknown)
        right = grouped_sums(np.einsum("nri,nr,nr->ni", slopes, now, wanted), view, count)
        found = np.linalg.solve(normal, right[:, :, None])[:, :, 0]
        off = wanted - np.einsum("nri,ni->nr", slopes, found[view])
        squares = off**2 * weight
        robust = 1 / (1 + squares[:, 2] / CAUCHY_K**2)
    along = np.bincount(view, CAUCHY_K**2 * np.log1p(squares[:, 2] / CAUCHY_K**2), count).astype(np.float64)
    cost = np.bincount(view, squares[:, :2].sum(axis=1), count) + along + (prior * found**2).sum(axis=1)
    speed, variance = np.zeros(count), np.full(count, np.inf)
    if moving:
        way = grouped_sums(sights.direction, view, count)
        way /= np.maximum(lengths(way), 1e-9)[:, None]
        speed = (way * found[:, 4:]).sum(axis=1)
        variance = np.einsum("vi,vij,vj->v", way, np.linalg.inv(normal)[:, 4:, 4:], way)
    return PointFit(cost, along, speed, variance, off[:, 2])


def noise_about_motions(views: Views) -> Floats:
    """Return the factors (V,) on the nominal noise of ranges, from the scatter of each label's ranges about points with a
    constant velocity.

    So the motion of a thing does not count as noise, but jumps of ranges between a thing and its background do. views: at
    least one view has `FEWEST` ranges.
    """
    labels, number = int(views.label.max()) + 1, views.number
    label, judged = views.label[views.view], np.isfinite(views.sights.range) & (number >= FEWEST)[views.view]
    larger = np.sqrt(number / np.maximum(number - 2, 1))[views.view]  # A line takes up the noise of two ranges.
    free, level = np.bincount(views.label, np.maximum(number - 2, 0), labels), np.ones(len(number))
    for _ in range(2):  # The first fit does not know the noise yet.
        off = np.abs(fit_point(views, level, moving=True).off) * larger / views.sights.nominal
        every = float(np.median(off[judged])) / NORMAL_MEDIAN
        own = np.nan_to_num(grouped_median(off[judged], label[judged], labels)) / NORMAL_MEDIAN
        level = np.maximum(np.sqrt((_PRIOR * every**2 + free * own**2) / (_PRIOR + free)), _LEAST_NOISE)[views.label]
    return level
