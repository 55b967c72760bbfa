"""What association believes at one moment: landmarks as points, and the landmark of each ray."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Self

import numpy as np

from objslam.association.observations import Observations
from objslam.association.refinement import BEHIND, normalised_residuals, variance
from objslam.association.visibility import CameraFrames, DetectionHistory, detection_history
from objslam.core.arrays import Bools, Floats, Ints
from objslam.core.statistics import NOISE_FACTORS, POOLED_WITH_CLASS, RAYLEIGH_MEDIAN, grouped_median


@dataclass(frozen=True)
class Landmarks:
    """Objects as points: position (N, 3) m, covariance (N, 3, 3) m^2, noise (N,) factor on the promised noise of their rays,
    accepts (N, L) whether a box of a label may be theirs."""

    position: Floats
    covariance: Floats
    noise: Floats
    accepts: Bools

    def __len__(self) -> int:
        return len(self.position)

    @classmethod
    def new(cls, position: Floats, noise: Floats, label: Ints, labels: int) -> Self:
        """Landmarks at exact positions that accept one label each: (N,), of the `labels` that there are."""
        accepts = np.zeros((len(position), labels), dtype=bool)
        accepts[np.arange(len(position)), label] = True
        return cls(position, np.zeros((len(position), 3, 3)), noise, accepts)

    def take(self, which: Bools | Ints) -> Self:
        """A selection."""
        return type(self)(self.position[which], self.covariance[which], self.noise[which], self.accepts[which])

    def and_also(self, other: Self) -> Self:
        """These landmarks, then the others."""
        pairs = ((getattr(self, name), getattr(other, name)) for name in ("position", "covariance", "noise", "accepts"))
        return type(self)(*(np.concatenate(pair) for pair in pairs))


@dataclass(frozen=True)
class PredictedLandmarks:
    """What the boxes of a session's next frame may be of: its landmarks in their order, then its candidates in theirs.

    landmarks: how many of the n are landmarks. id: (n,) negative for candidates. label: (n,) negative for a candidate that
    only its label ties together. position: (n, 3) m. covariance: (n, 3, 3) m^2. drift: (n, 6, 6) of the odometry when each
    was last seen. noise: (n,) factor on that of its rays. far: m, the greatest distance from which a landmark was seen.
    """

    landmarks: int
    id: Ints
    label: Ints
    position: Floats
    covariance: Floats
    drift: Floats
    noise: Floats
    far: float


@dataclass(frozen=True)
class State:
    """Landmarks, and matched (R,): the landmark of each observation, -1 none; view: the frames that were looked at.

    What follows from these is computed when it is first asked for, and kept. P of the R rays have a landmark.
    """

    obs: Observations
    view: CameraFrames
    landmarks: Landmarks
    matched: Ints

    @cached_property
    def count(self) -> int:
        """Number of landmarks, N."""
        return len(self.landmarks.position)

    @cached_property
    def assigned(self) -> Ints:
        """(P,) indices of the rays that have a landmark."""
        return np.flatnonzero(self.matched >= 0)

    @cached_property
    def owner(self) -> Ints:
        """(P,) the landmark of each of these rays."""
        return self.matched[self.assigned]

    @cached_property
    def distance(self) -> Floats:
        """(P,) m, from each of these rays' camera to its landmark."""
        return np.asarray(np.linalg.norm(self.landmarks.position[self.owner] - self.obs.origin[self.assigned], axis=1))

    @cached_property
    def variance(self) -> Floats:
        """(P,) m^2 per axis across, of the landmark's offset from the ray."""
        return variance(self.obs, self.distance, self.landmarks.noise[self.owner], self.assigned)

    @cached_property
    def deviation(self) -> Floats:
        """(P,) by how many of the promised standard deviations the ray passes its landmark."""
        return np.minimum(normalised_residuals(self.obs, self.landmarks.position[self.owner], of=self.assigned), BEHIND)

    @cached_property
    def ray_count(self) -> Ints:
        """(N,) rays of each landmark."""
        return np.bincount(self.owner, minlength=self.count)

    @cached_property
    def label_count(self) -> Ints:
        """(N, L) how many rays of each label each landmark has."""
        count, labels = self.landmarks.accepts.shape
        flat = np.bincount(self.owner * labels + self.obs.label[self.assigned], minlength=count * labels)
        return flat.reshape(count, labels)

    @cached_property
    def label(self) -> Ints:
        """(N,) the label that most rays of each landmark have."""
        return self.label_count.argmax(axis=1)

    @cached_property
    def unassigned(self) -> Ints:
        """(L,) how many rays of each label have no landmark."""
        return np.bincount(self.obs.label[self.matched < 0], minlength=self.landmarks.accepts.shape[1])

    @cached_property
    def class_noise(self) -> Floats:
        """(L,) by what factor the rays of each label are noisier than promised, drawn to 1 where they are few."""
        labels, label = len(self.unassigned), self.label[self.owner]
        number = np.bincount(label, minlength=labels)
        middle = np.nan_to_num(grouped_median(self.deviation, label, labels)) / RAYLEIGH_MEDIAN
        return np.clip((number * middle + POOLED_WITH_CLASS) / (number + POOLED_WITH_CLASS), *NOISE_FACTORS)

    @cached_property
    def noise(self) -> Floats:
        """(N,) the same factor for each landmark, drawn to that of its class."""
        middle = np.nan_to_num(grouped_median(self.deviation, self.owner, self.count)) / RAYLEIGH_MEDIAN
        own, number = np.minimum(middle, NOISE_FACTORS[1]), self.ray_count
        pooled = number * own + POOLED_WITH_CLASS * self.class_noise[self.label]
        return np.clip(pooled / (number + POOLED_WITH_CLASS), *NOISE_FACTORS)

    @cached_property
    def size(self) -> Floats:
        """(N,) m, geometric mean of width and height, the median over its boxes; 0 without any."""
        size = np.sqrt(self.obs.size[self.assigned].prod(axis=1)) * self.distance
        return np.nan_to_num(grouped_median(size, self.owner, self.count))

    @cached_property
    def ray_sigma(self) -> Floats:
        """(N,) m, the median standard deviation across of each landmark's rays at its distance; 0 without any."""
        return np.nan_to_num(grouped_median(np.sqrt(self.variance), self.owner, self.count))

    @cached_property
    def history(self) -> DetectionHistory:
        """Where the landmarks were detected or should have been."""
        return detection_history(self.obs, self.matched, self.landmarks.position, self.label, self.view)

    def keep(self, which: Bools) -> State:
        """Keep some of the landmarks (N,) bool; the rays of the others have none."""
        if which.all():
            return self
        number = np.append(np.cumsum(which) - 1, -1)
        kept = np.append(which, False)
        matched = np.where(kept[self.matched], number[self.matched], -1)
        return replace(self, landmarks=self.landmarks.take(which), matched=matched)

    def merge(self, target: Ints) -> State:
        """Make each landmark part of another one, or leave it: target (N,) says of which, itself to leave it."""
        accepts = np.zeros_like(self.landmarks.accepts)
        np.logical_or.at(accepts, target, self.landmarks.accepts)
        landmarks, matched = replace(self.landmarks, accepts=accepts), np.append(target, -1)[self.matched]
        return replace(self, landmarks=landmarks, matched=matched).keep(target == np.arange(len(target)))
