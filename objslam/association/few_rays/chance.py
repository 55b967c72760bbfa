"""Estimate how unlikely it is that the rays of a landmark meet by chance.

Two explanations of the rays are compared: all rays show one object, or each ray is from a stray box. Stray boxes are assumed
to be distributed, over the images and over the ranges, like the boxes of their label in this log. The odds have a meaning
for any number of rays. They are the score of a track in multiple hypothesis tracking (Blackman, IEEE AES Magazine 19, 2004),
with the unknown position integrated out.
"""

from dataclasses import dataclass, replace

import numpy as np

from objslam.association.existence import Rates
from objslam.association.gating import Edges
from objslam.association.landmarks import State
from objslam.association.observations import Observations
from objslam.association.refinement import range_costs, variance
from objslam.association.visibility import CameraFrames
from objslam.core.arrays import Floats, Ints
from objslam.core.ground.flattening import raised_points
from objslam.core.statistics import grouped_median, grouped_sums

MOST_ODDS = 20.0
"""The largest absolute log odds against chance. This limit only keeps them finite."""
_BINS = 256
"""The number of bins of a density along one coordinate. A larger number resolves narrower densities, and is slower."""
_OUTSIDE = 1e-6
"""The density of boxes, in the units of `_Density`, at places far from all boxes of the log. It only keeps logarithms
finite."""
_LOG_RANGE = 4.6
"""The width of the uniform density of ln range if no range is known. It is a factor of 100 in range."""
_WRONG_RANGE = 0.1
"""The assumed share of correct boxes that have a wrong range. A larger share trusts ranges less."""
_TRIED = 25
"""The number of tried values, for the share of strays and for the density of objects. A larger number is more exact."""
_DENSITY_FACTORS = np.geomspace(1e-4, 10.0, _TRIED)
"""The tried factors on the density of objects that follows from the density of boxes. A factor is needed because objects do
not lie everywhere where boxes could show objects. A larger upper limit keeps more landmarks with few rays."""
_SHARES = np.geomspace(1e-4, 1.0, _TRIED)
"""The tried shares of stray boxes. A smaller lower limit trusts the boxes of a clean log more."""
_PRIOR_STRAYS = 1.0
"""The number of strays of each label that are assumed in addition to the strays in the log. A larger number keeps fewer
landmarks."""
_LOOK = np.radians(2.0)
"""Two rays of a landmark count as independent if the angle (rad) between them is at least this. It is the least parallax of
a position. A larger angle drops more moving objects, and more objects that were seen from nearly one place."""
_PRIOR = 0.5
"""The prior share of boxes that show an object. A larger share keeps more landmarks with few rays."""


@dataclass(frozen=True)
class _Density:
    """The density of boxes along one coordinate, for each label. low: where the first bin begins. width: the width of a bin.
    value: (L, bins)."""

    low: float
    width: float
    value: Floats

    @classmethod
    def of(cls, x: Floats, label: Ints, labels: int, noise: Floats, reach: float = 0.0) -> "_Density":
        """Estimate densities from values (R,) and their noise (L,), with a Gaussian kernel. reach: the largest absolute
        value that is possible, 0 if unknown.

        Few boxes leave gaps between their kernels. So a uniform density is added. Its weight is larger if fewer boxes lie in
        a kernel.
        """
        pad = 2 * float(noise.max(initial=1e-6))
        low, high = (float(x.min()) - pad, float(x.max()) + pad) if len(x) else (-pad, pad)
        if reach:
            low, high = min(low, -reach), max(high, reach)
        width = (high - low) / _BINS
        counts = np.bincount(label * _BINS + _bins(x, low, width), minlength=labels * _BINS).reshape(labels, _BINS)
        number = counts.sum(axis=1)
        value = np.empty((labels, _BINS))
        for i, sigma in enumerate((noise / width).tolist()):
            spread = _smoothed(counts[i], max(sigma, 0.5))
            in_kernel = number[i] * min(2 * sigma / _BINS, 1.0)
            value[i] = (spread * in_kernel / max(number[i], 1) + 1 / _BINS) / (1 + in_kernel)
        return cls(low, width, value / value.sum(axis=1, keepdims=True) / width)

    def at(self, x: Floats, label: Ints) -> Floats:
        """Return the density at values x among the boxes of labels. Both may have any shapes that broadcast together."""
        inside = np.abs((x - self.low) / self.width - _BINS / 2) <= _BINS / 2
        return np.where(inside, self.value[label, _bins(x, self.low, self.width)], _OUTSIDE)


def _smoothed(counts: Ints, sigma: float) -> Floats:
    """Return counts (n,) spread by a Gaussian kernel with a standard deviation of `sigma` bins."""
    half = min(int(4 * sigma) + 1, len(counts))
    kernel = np.exp(-0.5 * (np.arange(-half, half + 1) / sigma) ** 2)
    return np.asarray(np.convolve(np.pad(counts.astype(np.float64), half, "edge"), kernel / kernel.sum(), "valid"))


def _bins(x: Floats, low: float, width: float) -> Ints:
    return np.clip((x - low) / width, 0, _BINS - 1).astype(np.int64)


@dataclass(frozen=True)
class Strays:
    """The density of stray boxes.

    image: (R,) sr^-1, the density of the boxes of a ray's label at the place of the ray in the image. frames: the number of
    frames. log_range: the densities of ln range, None if no ray has a range. ranged: (L,) the share of boxes with a range.
    """

    image: Floats
    frames: int
    log_range: _Density | None
    ranged: Floats

    @classmethod
    def of(cls, obs: Observations, view: CameraFrames, labels: int) -> "Strays":
        """Estimate the density from all boxes of the log.

        The coordinates in the image are the angle about the vertical axis of the camera and the sine of the angle to its
        horizontal plane. Equal areas are equal solid angles. The coordinates count as independent. So boxes that all lie in
        one row need no special rule.
        """
        direction = raised_points(obs.direction, obs.scale)
        direction = direction / np.linalg.norm(direction, axis=1, keepdims=True)
        x, y, z = np.einsum("rji,rj->ir", view.map_T_camera[obs.frame, :3, :3], direction)
        known = np.flatnonzero(np.isfinite(obs.range))
        angle = obs.sigma.copy()
        angle[known] = np.hypot(angle[known], obs.position_sigma / obs.range[known])
        noise = np.nan_to_num(grouped_median(angle, obs.label, labels))
        wide = min(max(camera.view_angle for camera in view.cameras), np.pi)
        columns = (np.arctan2(x, z), wide), (y, min(view.solid_angle / (4 * wide), 1.0))
        image = np.full(len(obs), 1 / obs.scale)  # In a flattened world, the same boxes fill a smaller solid angle.
        for column, reach in columns:
            image *= _Density.of(column, obs.label, labels, noise, reach).at(column, obs.label)
        if not len(known):
            return cls(image, len(view.camera), None, np.zeros(labels))
        noise = np.nan_to_num(grouped_median(obs.range_sigma[known] / obs.range[known], obs.label[known], labels))
        log_range = _Density.of(np.log(obs.range[known]), obs.label[known], labels, noise)
        each = np.maximum(np.bincount(obs.label, minlength=labels), 1)
        return cls(image, len(view.camera), log_range, np.bincount(obs.label[known], minlength=labels) / each)

    def take(self, rays: Ints) -> "Strays":
        """Select rays."""
        return replace(self, image=self.image[rays])

    def per_frame(self, number: Floats | float) -> Floats:
        """Return the mean number of strays in a frame. At least one stray is assumed in the log."""
        return np.asarray(np.maximum(number, 1.0) / max(self.frames, 1))

    def along(self, distance: Floats, label: Ints) -> Floats:
        """Return the density (E,), m^-1, of boxes of a label (E,) at a distance (E,), m, from the camera."""
        anywhere = 1 / _LOG_RANGE
        if self.log_range is None:
            return anywhere / distance
        share = self.ranged[label]
        return (share * self.log_range.at(np.log(distance), label) + (1 - share) * anywhere) / distance


def ray_odds(
    obs: Observations,
    strays: Strays,
    number: Floats | float,
    off2: Floats,
    distance: Floats,
    noise: Floats | float,
    gate: float,
) -> tuple[Floats, Floats]:
    """Return the log odds (..., R) that each ray shows its point and is no stray, and the density of strays, m^-2.

    number: (..., R) the number of strays of the ray's label in the log. off2: (..., R) m^2, the squared distance of the
    point from the ray. distance: (..., R) m, of the point from the camera. noise: factor on the noise of the rays. A
    deviation beyond `gate` costs as much as one at the gate.
    """
    # The tables can have hundreds of points and all rays, so they are changed in place where possible.
    distance2 = distance**2
    spread = obs.sigma**2 * distance2
    spread += obs.position_sigma**2
    spread *= noise**2
    density = strays.per_frame(number) * strays.image / distance2
    odds = np.minimum(off2 / spread, gate)
    odds *= -0.5
    spread *= density
    spread *= 2 * np.pi
    odds -= np.log(spread, out=spread)
    known = np.isfinite(obs.range)
    ranged = slice(None) if known.all() else np.flatnonzero(known)
    if known.any():
        told, sigma = obs.range[ranged], obs.range_sigma[ranged]
        away, label = distance[..., ranged], obs.label[ranged]
        fit = away - told
        fit /= sigma
        fit *= fit
        fit *= -0.5
        np.exp(fit, out=fit)
        fit *= (1 - _WRONG_RANGE) / (np.sqrt(2 * np.pi) * sigma * strays.along(told, label))
        wrong = strays.along(away, label)
        wrong *= away
        wrong *= _LOG_RANGE
        np.minimum(wrong, 1.0, out=wrong)
        wrong *= _WRONG_RANGE
        fit += wrong
        odds[..., ranged] += np.log(fit, out=fit)
    return odds, density


def unmatched_costs(state: State, edges: Edges, strays: Strays, gate: float) -> Floats:
    """Return for each match the cost (E,) of its ray if the ray had no landmark.

    The cost is -2 ln of the density of strays, relative to the density of the landmark's rays at their peak, and at most
    `gate`. So the cost is below `gate` only where strays are dense compared with the noise of the rays. Boxes within the
    gate of the landmark do not count as strays.
    """
    obs, noise = state.obs.take(edges.ray), state.landmarks.noise[edges.landmark]
    distance = np.linalg.norm(state.landmarks.position[edges.landmark] - obs.origin, axis=1)
    near = np.bincount(edges.landmark[state.matched[edges.ray] < 0], minlength=state.count)
    number = np.maximum(state.unassigned[obs.label] - near[edges.landmark], 1.0)
    odds, _ = ray_odds(obs, strays.take(edges.ray), number, np.zeros(len(distance)), distance, noise, gate)
    return np.clip(2 * odds + range_costs(obs, distance), 0.0, gate)


def chance_odds(state: State, gate: float, strays: Strays, rates: Rates) -> Floats:
    """Return the log odds (N,) of one object over stray boxes, from the rays of each landmark. Misses do not count.

    If the rays show one object, its position x may be anywhere where boxes of its label are. Then p(rays) = int p(x) prod
    p(ray | x) dx, by Laplace's method. If the rays are strays, each box has the density of the label's strays.
    """
    total, label = _evidence(state, gate, strays, rates), state.label
    grid = _likelihoods(total, _looks(state), label, *_expected(state, rates))
    density, share = np.unravel_index(grid.reshape(len(grid), -1).argmax(axis=1), (_TRIED, _TRIED))
    odds = total + np.log(_DENSITY_FACTORS[density])[label] - _looks(state) * np.log(_SHARES[share])[label]
    return np.clip(odds, -MOST_ODDS, MOST_ODDS)


def log_evidence(state: State, gate: float, strays: Strays, rates: Rates) -> float:
    """Return the log odds of all landmarks together over the case that all boxes are strays.

    The share of strays and the density of objects are chosen for each label, so that they fit best.
    """
    boxes, objects = _expected(state, rates)
    grid = _likelihoods(_evidence(state, gate, strays, rates), _looks(state), state.label, boxes, objects)
    return float((grid.reshape(len(grid), -1).max(axis=1) + boxes)[boxes > 0].sum())


def _evidence(state: State, gate: float, strays: Strays, rates: Rates) -> Floats:
    """Return the log odds (N,) of each landmark if all boxes of its label may be strays."""
    held, owner, label = state.assigned, state.owner, state.label
    obs, distance = state.obs.take(held), np.maximum(state.distance, 1e-3)
    off2 = state.deviation**2 * variance(obs, distance, 1.0)
    boxes = state.label_count.sum(axis=0) + state.unassigned
    odds, _ = ray_odds(obs, strays.take(held), boxes[label][owner], off2, distance, state.landmarks.noise[owner], gate)
    looks = _looks(state) / np.maximum(state.ray_count, 1)
    return np.asarray(looks * np.bincount(owner, odds, state.count) - log_places(state, strays, rates))


def _looks(state: State) -> Floats:
    """Return the number (N,) of independent looks at each landmark.

    Strays from nearly one place are often one thing: an error that the detector repeats in the next image, or an object that
    moves slowly. So the weight of a ray is its angle to the ray before it, seen from the landmark, divided by `_LOOK`. The
    weight is at most 1, and the first ray has the weight 1.
    """
    order = np.lexsort((state.obs.frame[state.assigned], state.owner))
    owner = state.owner[order]
    to = state.landmarks.position[owner] - state.obs.origin[state.assigned[order]]
    to = to / np.maximum(np.linalg.norm(to, axis=1, keepdims=True), 1e-9)
    turn = np.linalg.norm(np.diff(to, axis=0, prepend=to[:1]), axis=1)
    counted = np.where(np.diff(owner, prepend=-1) != 0, 1.0, np.minimum(turn / _LOOK, 1.0))
    return np.asarray(np.bincount(owner, counted, state.count).astype(np.float64))


def _expected(state: State, rates: Rates) -> tuple[Ints, Floats]:
    """Return the number (L,) of boxes of each label, and the number of objects (L,) that would give these boxes."""
    boxes = np.asarray(state.label_count.sum(axis=0) + state.unassigned)
    landmarks = np.maximum(np.bincount(state.label, minlength=len(boxes)), 1)
    looks = rates.mean * np.bincount(state.label, state.history.expected, len(boxes)) / landmarks
    return boxes, np.asarray(_PRIOR * boxes / np.maximum(looks, 1.0))


def _likelihoods(odds: Floats, number: Floats, label: Ints, boxes: Ints, objects: Floats) -> Floats:
    """Return the log likelihoods (L, D, S) of the density of objects and of the share of stray boxes, for each label.

    The tried densities are the factors m in `_DENSITY_FACTORS` (D,), and the tried shares are the c in `_SHARES` (S,). The
    numbers of strays and objects are Poisson distributed. The mean number of strays is c n, for n boxes. The mean number of
    objects is m times the nominal number. Then the likelihood is c^n exp(-c n - m objects), times a factor for each
    landmark. This factor is 1 + m o c^-k for a landmark with k rays whose odds are o at c = m = 1. odds: (N,) ln o. number:
    (N,) k. label: (N,) of the landmarks. boxes, objects: (L,) the numbers of boxes, and the nominal numbers of objects.
    """
    log_share, log_density = np.log(_SHARES), np.log(_DENSITY_FACTORS)
    grid = np.zeros((len(boxes), _TRIED, _TRIED))
    for j in np.flatnonzero(boxes).tolist():
        mine = label == j
        gain = odds[mine, None] - number[mine, None] * log_share
        grid[j] = [np.logaddexp(0.0, gain + m).sum(axis=0) for m in log_density]
    grid += boxes[:, None, None] * (log_share - _SHARES) + _PRIOR_STRAYS * log_share
    grid -= objects[:, None, None] * _DENSITY_FACTORS[:, None]
    return grid


def log_places(state: State, strays: Strays, rates: Rates) -> Floats:
    """Return ln of the number (N,) of places that each landmark could have been at.

    The number is the volume to which the rays confine the position, times the density of objects. This density follows from
    the boxes at the rays, because each object is detected in a frame with the rate of its class.
    """
    held, owner, label = state.assigned, state.owner, state.label
    distance = np.maximum(state.distance, 1e-3)
    boxes = state.label_count.sum(axis=0) + state.unassigned
    density = strays.per_frame(boxes[label][owner]) * strays.image[held] / distance**2
    density = density * strays.along(distance, label[owner])
    number = np.maximum(state.ray_count, 1)
    objects = _PRIOR / rates.mean[label] * np.bincount(owner, density, state.count) / number
    return np.asarray(-np.log(np.maximum(objects, 1e-300)) - _volume(state))


def log_volume(information: Floats, distance: Floats) -> Floats:
    """Return ln of the volume (N,) m^3 of a position with this information (N, 3, 3) m^-2. In each direction, its extent is
    at most the distance (N,) m from the cameras."""
    least = 1 / np.maximum(distance, 1e-3) ** 2
    eigen = np.maximum(np.linalg.eigvalsh(information), least[:, None])
    return np.asarray(1.5 * np.log(2 * np.pi) - 0.5 * np.log(eigen).sum(axis=1))


def _volume(state: State) -> Floats:
    obs, held, owner = state.obs, state.assigned, state.owner
    to = state.landmarks.position[owner] - obs.origin[held]
    to = to / np.maximum(np.linalg.norm(to, axis=1, keepdims=True), 1e-9)
    along = to[:, :, None] * to[:, None, :]
    weight = np.nan_to_num(1 / obs.range_sigma[held] ** 2)
    each = (np.eye(3) - along) / state.variance[:, None, None] + weight[:, None, None] * along
    information = grouped_sums(each.reshape(-1, 9), owner, state.count).reshape(-1, 3, 3)
    return log_volume(information, np.bincount(owner, state.distance, state.count) / np.maximum(state.ray_count, 1))
