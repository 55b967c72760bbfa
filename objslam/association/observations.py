"""Represent rays as lines in the map, with their closest approaches and the sizes of the things that they observe.

The sizes of boxes are also evidence. A landmark has usual sizes, and a box of an unusual size costs more.
"""

from dataclasses import dataclass, fields, replace
from functools import cached_property, lru_cache
from typing import Any, Self

import numpy as np

from objslam.core.appearance.features import FeatureTable
from objslam.core.arrays import Bools, Floats, Ints
from objslam.core.camera import Camera, box_sizes
from objslam.core.ground.flattening import LEVEL, flattened_lines
from objslam.core.rotation import cross, dots
from objslam.core.statistics import NORMAL_MEDIAN, grouped_median, order_by_group
from objslam.core.types import Association, Keyframes, Rays

MIN_DEPTH = 0.05
"""The least distance (m) of an object from a camera. A larger value loses objects right in front of the camera."""
SIZE_SPREAD = 0.25
"""The expected standard deviation of ln width and ln height over the boxes of a landmark. The sizes change with the side and
with the detector. With a larger value, only larger differences of size count."""
_SIZE_POOLED = 5.0
"""With this many boxes, the measured spread of a landmark's sizes weighs as much as `SIZE_SPREAD`. A larger number trusts
the measured spread less."""
SIZED_BY = 5
"""The least number of boxes that give a landmark a size. A larger number leaves more landmarks without a size."""
_SIZE_FREE = 5.99
"""The largest squared deviation of a size without a cost. It is chi-squared of 2 degrees of freedom at 95 %. With a larger
value, only larger differences of size count."""
SIZE_LOSS = 6.0
"""The largest cost of a size, unless the box is of a nearer thing. This cost is less than a usual gate, so that the bearing
alone can still match a half hidden thing. A larger value loses more boxes of half hidden things."""
_ONE_FACTOR = 3.84
"""Both sides of a box count as larger by one factor if their squared deviation from this factor is at most this value. It is
chi-squared of 1 degree of freedom at 95 %. With a larger value, boxes with other proportions than those of the landmark also
count as boxes of nearer things."""
RANGE_LIMIT = 3.0
"""The deviation, in standard deviations, from which a range counts as wrong. A larger value believes more ranges."""


@dataclass(frozen=True)
class LinesByLabel:
    """Lines (R,) in the map, sorted by label. Two matrix products compare all lines of a label with points.

    order: (R,) the observations in this order. bounds: (L + 1,) where the lines of each label begin and end. centre: (3,) m,
    the mean of the origins. A point p, in m from the centre, is multiplied with the column of a line. (p, 1) times the
    column in `depth` (4, R) is the depth of p along the line. (p, p p, 1) times the column in `distance2` (5, R) is the
    squared distance of p from the origin of the line. sigma2: (R,) rad^2, the squared noise.
    """

    order: Ints
    bounds: Ints
    centre: Floats
    depth: Floats
    distance2: Floats
    sigma2: Floats


@dataclass(frozen=True)
class Observations:
    """R boxes as lines in the map. They are sorted by frame, then by the values of the box, so the input order has no
    effect. frame: (R,) index of the frame in time order. label: (R,) index of the label. origin: (R, 3) m in map. direction:
    (R, 3) unit in map. sigma: (R,) rad, noise along each perpendicular axis. position_sigma: m, noise of the origins. range:
    (R,) m, NaN if unknown. range_sigma: (R,) m. size: (R, 2) width and height of the object per metre of its distance. box:
    (R, 4) px. track: (R,) id of the track, -1 if unknown. feature: (R,) the row of the box's appearance vector in
    feature_table, -1 without one. feature and feature_table are None if no box has a vector. scale: the factor by which the
    world of the lines and landmarks is flattened along z (`core.ground.flattening`)."""

    frame: Ints
    label: Ints
    origin: Floats
    direction: Floats
    sigma: Floats
    position_sigma: float
    range: Floats
    range_sigma: Floats
    size: Floats
    box: Floats
    track: Ints
    feature: Ints | None = None
    feature_table: FeatureTable | None = None
    scale: float = LEVEL

    def __len__(self) -> int:
        return len(self.frame)

    @classmethod
    def of_lines(
        cls, origin: Floats, direction: Floats, sigma: Floats, range_: Floats, range_sigma: Floats, label: Ints | None = None
    ) -> Self:
        """Make observations of R lines in map, all in one frame, without boxes and tracks. label: (R,), 0 by default."""
        zero, minus, size, box = _nothing(len(origin))
        label = zero if label is None else label
        return cls(zero, label, origin, direction, sigma, 0.0, range_, range_sigma, size, box, minus)

    def take(self, rays: Bools | Ints) -> Self:
        """Select rays by a mask or by increasing indices."""
        rows = np.flatnonzero(rays) if rays.dtype == bool else rays
        values = {field.name: getattr(self, field.name) for field in fields(self)}
        selected: dict[str, Any] = {k: v.take(rows, axis=0) if isinstance(v, np.ndarray) else v for k, v in values.items()}
        return type(self)(**selected)

    @cached_property
    def by_label(self) -> LinesByLabel:
        """The lines, sorted by label."""
        labels = int(self.label.max(initial=-1)) + 1
        order = order_by_group(self.label, labels)
        bounds = np.searchsorted(self.label[order], np.arange(labels + 1))
        centre = self.origin.mean(axis=0)
        m, n = (np.ascontiguousarray(rows.take(order, axis=0).T) for rows in (self.origin - centre, self.direction))
        distance2 = np.stack([*(-2 * m), np.ones(len(order)), dots(m, m)])
        return LinesByLabel(order, bounds, centre, np.stack([*n, -dots(m, n)]), distance2, self.sigma[order] ** 2)

    def noisier(self, factor: float) -> Self:
        """Return the rays with a factor on their nominal noise."""
        return replace(self, sigma=self.sigma * factor, position_sigma=self.position_sigma * factor)


@lru_cache(maxsize=256)
def _nothing(count: int) -> tuple[Ints, Ints, Floats, Floats]:
    zero = np.zeros(count, dtype=np.int64)
    columns = zero, zero - 1, np.zeros((count, 2)), np.zeros((count, 4))
    for column in columns:
        column.flags.writeable = False
    return columns


def closest_approach(obs: Observations, first: Ints, second: Ints) -> tuple[Floats, Floats, Floats, Floats, Floats]:
    """Return the closest approach of P pairs of rays. first, second: (P,) the indices of the two rays of each pair.

    The values are the distances along the first and the second ray (P,) m, the midpoint (P, 3) m, the squared gap (P,) m^2,
    and the squared sine of the angle between the rays (P,).
    """
    m, n, o, p = obs.origin[first], obs.direction[first], obs.origin[second], obs.direction[second]
    between, cos, normal = o - m, np.einsum("pi,pi->p", n, p), cross(n, p)
    sin2 = np.maximum(np.einsum("pi,pi->p", normal, normal), 1e-12)
    a, b = np.einsum("pi,pi->p", between, n), np.einsum("pi,pi->p", between, p)
    along_first, along_second = (a - cos * b) / sin2, (cos * a - b) / sin2
    one, two = m + along_first[:, None] * n, o + along_second[:, None] * p
    gap = one - two
    return along_first, along_second, (one + two) / 2, np.einsum("pi,pi->p", gap, gap), sin2


@dataclass(frozen=True)
class PosedRays:
    """The rays of K keyframes at given camera poses, with their noise.

    keyframes, rays: all observed frames and their rays. Frames without a ray count as misses. map_T_camera: (K, 4, 4) the
    camera poses of the keyframes. sigma: (R,) rad, the noise of the directions. position_sigma: m, the noise of the origins
    along each axis. scale: as in `Observations`.
    """

    rays: Rays
    keyframes: Keyframes
    cameras: tuple[Camera, ...]
    map_T_camera: Floats
    sigma: Floats
    position_sigma: float = 0.0
    scale: float = LEVEL


def observe(of: PosedRays) -> tuple[Observations, Ints, Ints]:
    """Return the rays as observations, the ray (R,) of each observation, and the keyframe (K,) of each frame.

    Frames are sorted by time and camera. Boxes in a frame are sorted by label and coordinates. So the input order has no
    effect.
    """
    keyframes, rays = of.keyframes, of.rays
    keyframe = np.lexsort((keyframes.frame, keyframes.camera, keyframes.stamps))
    frame = np.argsort(keyframe)[rays.keyframe]
    ray = np.lexsort((*rays.direction.T, rays.range, rays.score, *rays.box.T[::-1], rays.label, frame))
    rays, frame = rays.take(ray), frame[ray]
    origin, direction, longer = flattened_lines(*rays.in_map(of.map_T_camera), of.scale)
    known = np.isfinite(rays.range) & (rays.range > 0) & np.isfinite(rays.range_sigma) & (rays.range_sigma > 0)
    range_, range_sigma = (np.where(known, values * longer, np.nan) for values in (rays.range, rays.range_sigma))
    lines = Observations.of_lines(origin, direction, of.sigma[ray], range_, range_sigma, rays.label)
    size = size_per_metre(rays, keyframes, of.cameras)
    obs = replace(lines, frame=frame, position_sigma=of.position_sigma, size=size, box=rays.box, track=rays.track_id)
    obs = replace(obs, feature=rays.feature, feature_table=rays.feature_table, scale=of.scale)
    return obs, ray, keyframe


def size_per_metre(rays: Rays, keyframes: Keyframes, cameras: tuple[Camera, ...]) -> Floats:
    """Return width and height (R, 2) of the object in each box, in m per m of its distance."""
    return box_sizes(rays.box, rays.direction, cameras, keyframes.camera[rays.keyframe])


def extents(
    rays: Rays,
    association: Association,
    positions: Floats,
    map_T_camera: Floats,
    keyframes: Keyframes,
    cameras: tuple[Camera, ...],
) -> Floats:
    """Return the width and height (N, 2) m of each object at its position (N, 3) m, as medians over its rays.

    The size is NaN for an object without a ray or a position, and if at least half of its rays are from cameras that observe
    no sizes. map_T_camera: (K, 4, 4) of the keyframes.
    """
    held = np.flatnonzero(association.object >= 0)
    index = association.object[held]
    distance = np.linalg.norm(positions[index] - map_T_camera[rays.keyframe[held], :3, 3], axis=1)
    size = size_per_metre(rays.take(held), keyframes, cameras) * distance[:, None]
    size[~np.array([c.sees_size for c in cameras])[keyframes.camera[rays.keyframe[held]]]] = np.nan
    return grouped_median(size, index, len(association.label))


def overlap(one: Floats, two: Floats) -> Floats:
    """Return the intersection over union of boxes (..., 4) whose shapes broadcast together."""
    # A product of two columns takes a third of the time of `prod` along a short axis.
    both = np.maximum(np.minimum(one[..., 2:], two[..., 2:]) - np.maximum(one[..., :2], two[..., :2]), 0.0)
    size, other = one[..., 2:] - one[..., :2], two[..., 2:] - two[..., :2]
    common = both[..., 0] * both[..., 1]
    total = size[..., 0] * size[..., 1] + other[..., 0] * other[..., 1] - common
    return np.asarray(common / np.maximum(total, 1e-12))


@dataclass(frozen=True)
class UsualSizes:
    """What the boxes of N landmarks usually measure.

    number: (N,) the number of boxes with a size. ln_size: (N, 2) medians of ln width and ln height (m). variance: (N, 2) the
    variances of ln width and ln height over the boxes of the landmark. Without boxes, the medians are NaN.
    """

    number: Ints
    ln_size: Floats
    variance: Floats

    @classmethod
    def of(cls, size: Floats, distance: Floats, owner: Ints, count: int) -> Self:
        """Compute the usual sizes from P boxes.

        size: (P, 2) width and height of the object per metre of its distance. A box with a size of 0 has no size. distance:
        (P,) m. owner: (P,) the landmark of each box. count: number N of landmarks.
        """
        known = np.flatnonzero((size > 0).all(axis=1))
        owner = owner[known]
        own = np.log(size[known]) + np.log(distance[known])[:, None]
        number = np.bincount(owner, minlength=count)
        middle = grouped_median(own, owner, count)
        spread = np.nan_to_num(grouped_median(np.abs(own - middle[owner]), owner, count)) / NORMAL_MEDIAN
        weight = number[:, None]
        return cls(number, middle, (weight * spread**2 + _SIZE_POOLED * SIZE_SPREAD**2) / (weight + _SIZE_POOLED))

    def take(self, which: Ints) -> Self:
        """Select landmarks by indices (n,)."""
        return type(self)(*(getattr(self, f.name)[which] for f in fields(self)))

    def costs(
        self, obs: Observations, ray: Ints, landmark: Ints, distance: Floats, distance_sigma: Floats | None = None
    ) -> Floats:
        """Return the cost (E,) >= 0 of the size of the box in each match, in squared standard deviations.

        Bearings do not distinguish a small thing from a large thing on the same line of sight. If only one of the two things
        is detected, its box fits the bearings of both things, but the size of only one. So boxes of an unusual size cost
        more. The cost is at most `SIZE_LOSS`, because a thing can be half hidden, and a box can have two things side by
        side. The cost has no limit if both sides are larger than usual by one factor and the range is too short. Then size
        and range show a nearer thing. A box without a size, and a landmark with few boxes, cost nothing. ray, landmark: (E,)
        of the matches. distance: (E,) m, from the camera to the landmark. distance_sigma: (E,) m, the standard deviation of
        the distance, by default 0.
        """
        cost = np.zeros(len(ray))
        some = np.flatnonzero((self.number[landmark] >= SIZED_BY) & (obs.size[ray] > 0).all(axis=1))
        if not len(some):
            return cost
        ray, landmark = ray[some], landmark[some]
        size = obs.size[ray]
        noise = 2 * obs.sigma[ray, None] / size  # Two edges, each with sqrt(2) times a centre's noise.
        off = np.log(size) + np.log(distance[some])[:, None] - self.ln_size[landmark]
        spread = self.variance[landmark] + noise**2
        if distance_sigma is not None:
            spread += (distance_sigma[some] / distance[some])[:, None] ** 2
        squared = (off**2 / spread).sum(axis=1)
        factor = (off / spread).sum(axis=1) ** 2 / (1 / spread).sum(axis=1)  # What one factor on both sides explains.
        larger = (off > 0).all(axis=1) & (squared - factor <= _ONE_FACTOR)
        unsure = obs.range_sigma[ray] if distance_sigma is None else np.hypot(obs.range_sigma[ray], distance_sigma[some])
        nearer = larger & (distance[some] - obs.range[ray] > RANGE_LIMIT * unsure)  # False without a range.
        cost[some] = np.clip(squared - _SIZE_FREE, 0.0, np.where(nearer, np.inf, SIZE_LOSS))
        return cost
