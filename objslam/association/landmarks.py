"""What is believed at a moment: objects as points, and which ray is whose."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Self

import numpy as np

from objslam.association.extent import grouped_median
from objslam.association.sightings import Sightings
from objslam.types import Bools, Floats, Ints

RANGE_GAIN, RANGE_LOSS = 6.0, 4.0
"""What a range that fits perfectly takes off a match's cost, and the most that a wrong one adds: a box of something else
has its range anywhere within some metres, a right box has a wrong range one time in ten or so."""

BEHIND = 1e6
"""Standard deviations that count for infinitely many: a point behind the camera."""


@dataclass(frozen=True)
class Landmarks:
    """Objects as points: position (N, 3) m, covariance (N, 3, 3) m^2, noise (N,) factor on the rays' noise, accepts (N, L)
    whether a box of a label may be theirs."""

    position: Floats
    covariance: Floats
    noise: Floats
    accepts: Bools

    def __len__(self) -> int:
        return len(self.position)

    @classmethod
    def new(cls, position: Floats, noise: Floats, label: Ints, labels: int) -> Self:
        """Landmarks of one label each, label: (N,) of `labels`, where they are taken to be."""
        accepts = np.zeros((len(position), labels), dtype=bool)
        accepts[np.arange(len(position)), label] = True
        return cls(position, np.zeros((len(position), 3, 3)), noise, accepts)

    def take(self, which: Bools | Ints) -> Self:
        """A selection."""
        return type(self)(self.position[which], self.covariance[which], self.noise[which], self.accepts[which])

    def and_also(self, other: Self) -> Self:
        """These, and then the others."""
        pairs = ((getattr(self, name), getattr(other, name)) for name in ("position", "covariance", "noise", "accepts"))
        return type(self)(*(np.concatenate(pair) for pair in pairs))


@dataclass(frozen=True)
class State:
    """Landmarks, and matched (R,): the landmark of each sighting, -1 none."""

    landmarks: Landmarks
    matched: Ints

    @property
    def number(self) -> Ints:
        """(N,) rays of each landmark."""
        return np.bincount(self.matched[self.matched >= 0], minlength=len(self.landmarks))

    def labels(self, s: Sightings) -> Ints:
        """How many rays of each label each landmark has, (N, L)."""
        count, labels = self.landmarks.accepts.shape
        held = self.matched >= 0
        return np.bincount(self.matched[held] * labels + s.label[held], minlength=count * labels).reshape(count, labels)

    def kind(self, s: Sightings) -> Ints:
        """The label (N,) that most rays of each landmark have."""
        return self.labels(s).argmax(axis=1)

    def keep(self, which: Bools) -> State:
        """Only some of the landmarks (N,); the rays of the others go free."""
        number = np.append(np.cumsum(which) - 1, -1)
        kept = np.append(which, False)
        return State(self.landmarks.take(which), np.where(kept[self.matched], number[self.matched], -1))

    def merge(self, target: Ints) -> State:
        """Each landmark made part of another, or of itself: target (N,)."""
        accepts = np.zeros_like(self.landmarks.accepts)
        np.logical_or.at(accepts, target, self.landmarks.accepts)
        merged = State(replace(self.landmarks, accepts=accepts), np.append(target, -1)[self.matched])
        return merged.keep(target == np.arange(len(target)))


def variance(s: Sightings, distance: Floats, noise: Floats, of: Ints | slice = slice(None)) -> Floats:
    """Variance (E,), m^2 per axis across, of the offset of a landmark at `distance` (E,) m from its ray; of: (E,) which."""
    return np.asarray(noise**2 * ((s.sigma[of] * distance) ** 2 + s.place**2))


def offsets(s: Sightings, position: Floats) -> tuple[Floats, Floats]:
    """How far each ray passes its point (R, 3), squared (inf where that is behind), and how far away that is: (R,), m."""
    to = position - s.origin
    depth = np.einsum("ri,ri->r", to, s.direction)
    distance2 = np.einsum("ri,ri->r", to, to)
    return np.where(depth > 0, np.maximum(distance2 - depth**2, 0.0), np.inf), np.sqrt(distance2)


def range_costs(
    s: Sightings, distance: Floats, variance_along: Floats | float = 0.0, of: Ints | slice = slice(None)
) -> Floats:
    """What the range of a ray adds to the cost of a landmark at `distance` (E,) m, 0 where there is none; of: (E,) which."""
    measured = s.range[of]
    if not np.isfinite(measured).any():
        return np.zeros(len(distance))
    with np.errstate(invalid="ignore"):
        wrong = (distance - measured) ** 2 / (s.range_sigma[of] ** 2 + variance_along) - RANGE_GAIN
    return np.where(np.isfinite(wrong), np.minimum(wrong, RANGE_LOSS), 0.0)


def sizes(s: Sightings, state: State) -> Floats:
    """The size (N,) of each landmark, m: geometric mean of width and height, the median over its boxes; 0 without any."""
    held = np.flatnonzero(state.matched >= 0)
    index = state.matched[held]
    distance = np.linalg.norm(state.landmarks.position[index] - s.origin[held], axis=1)
    return np.nan_to_num(grouped_median(np.sqrt(s.size[held].prod(axis=1)) * distance, index, len(state.landmarks)))


def blurs(s: Sightings, state: State) -> Floats:
    """One standard deviation (N,), m, of the rays of each landmark at its distance; 0 without any."""
    held = np.flatnonzero(state.matched >= 0)
    index, r = state.matched[held], s.take(held)
    distance = np.linalg.norm(state.landmarks.position[index] - r.origin, axis=1)
    spread = np.sqrt(variance(r, distance, state.landmarks.noise[index]))
    return np.nan_to_num(grouped_median(spread, index, len(state.landmarks)))
