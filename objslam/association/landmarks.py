"""The state of association: landmarks as points, and the landmark of each ray."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import Self

import numpy as np

from objslam.association.appearance.cosine_ratio import CosineRatio
from objslam.association.appearance.evidence import Looks
from objslam.association.observations import Observations, UsualSizes
from objslam.association.refinement import BEHIND, normalised_residuals, variance
from objslam.association.visibility import CameraFrames, DetectionHistory, detection_history
from objslam.core.arrays import Bools, Floats, Ints
from objslam.core.statistics import NOISE_FACTORS, POOLED_WITH_CLASS, RAYLEIGH_MEDIAN, grouped_median


@dataclass(frozen=True)
class Landmarks:
    """Objects as points. position: (N, 3) m. covariance: (N, 3, 3) m^2. noise: (N,) factor on the nominal noise of the rays
    of each landmark. accepts: (N, L) whether a box of each label may belong to it."""

    position: Floats
    covariance: Floats
    noise: Floats
    accepts: Bools

    @classmethod
    def new(cls, position: Floats, noise: Floats, label: Ints, labels: int) -> Self:
        """Create landmarks at exact positions. Each accepts its own label (N,). labels: the number of all labels."""
        accepts = np.zeros((len(position), labels), dtype=bool)
        accepts[np.arange(len(position)), label] = True
        return cls(position, np.zeros((len(position), 3, 3)), noise, accepts)

    @classmethod
    def none(cls, labels: int) -> Self:
        """Return no landmarks. labels: the number of all labels."""
        return cls.new(np.zeros((0, 3)), np.zeros(0), np.zeros(0, dtype=np.int64), labels)

    def take(self, which: Bools | Ints) -> Self:
        """Select landmarks by a mask or by indices."""
        return type(self)(self.position[which], self.covariance[which], self.noise[which], self.accepts[which])

    def and_also(self, other: Self) -> Self:
        """Return these landmarks, followed by the landmarks of `other`."""
        return type(self)(*(np.concatenate([getattr(self, f.name), getattr(other, f.name)]) for f in fields(self)))


@dataclass(frozen=True)
class PredictedLandmarks:
    """The n landmarks and candidates that the next frame of a live session may show. The landmarks come first. landmarks:
    the number of landmarks. id: (n,) negative for candidates. label: (n,) negative for a candidate whose rays were grouped
    by label alone. position: (n, 3) m. covariance: (n, 3, 3) m^2. drift: (n, 6, 6) covariance of the odometry's drift from
    the start to the last observation. noise: (n,) factor on the noise of the rays. sizes: the usual sizes of their boxes.
    far: m, the greatest distance at which a landmark was seen."""

    landmarks: int
    id: Ints
    label: Ints
    position: Floats
    covariance: Floats
    drift: Floats
    noise: Floats
    sizes: UsualSizes
    far: float


@dataclass(frozen=True)
class State:
    """Landmarks and their observations. matched: (R,) the landmark of each observation, or -1. view: the observed frames.
    ratio: what the appearance of boxes says, None without appearance vectors.

    Properties are computed on first use and cached. R is the number of rays. P is the number of rays with a landmark.
    """

    obs: Observations
    view: CameraFrames
    landmarks: Landmarks
    matched: Ints
    ratio: CosineRatio | None = None

    @cached_property
    def count(self) -> int:
        """Number N of landmarks."""
        return len(self.landmarks.position)

    @cached_property
    def assigned(self) -> Ints:
        """Indices (P,) of the rays with a landmark."""
        return np.flatnonzero(self.matched >= 0)

    @cached_property
    def owner(self) -> Ints:
        """Landmark (P,) of each assigned ray."""
        return self.matched[self.assigned]

    @cached_property
    def distance(self) -> Floats:
        """Distance (P,) m from the camera of each assigned ray to its landmark."""
        return np.asarray(np.linalg.norm(self.landmarks.position[self.owner] - self.obs.origin[self.assigned], axis=1))

    @cached_property
    def variance(self) -> Floats:
        """Variance (P,) m^2 of the distance between each assigned ray and its landmark, along one axis across the ray."""
        return variance(self.obs, self.distance, self.landmarks.noise[self.owner], self.assigned)

    @cached_property
    def deviation(self) -> Floats:
        """Deviation (P,) of each assigned ray from its landmark, in standard deviations of its nominal noise. It is `BEHIND`
        for a landmark behind the camera."""
        return np.minimum(normalised_residuals(self.obs, self.landmarks.position[self.owner], of=self.assigned), BEHIND)

    @cached_property
    def ray_count(self) -> Ints:
        """Number (N,) of rays of each landmark."""
        return np.bincount(self.owner, minlength=self.count)

    @cached_property
    def label_count(self) -> Ints:
        """Number (N, L) of rays of each label for each landmark."""
        count, labels = self.landmarks.accepts.shape
        flat = np.bincount(self.owner * labels + self.obs.label[self.assigned], minlength=count * labels)
        return flat.reshape(count, labels)

    @cached_property
    def label(self) -> Ints:
        """Most frequent label (N,) among the rays of each landmark."""
        return self.label_count.argmax(axis=1)

    @cached_property
    def unassigned(self) -> Ints:
        """Number (L,) of rays without a landmark, for each label."""
        return np.bincount(self.obs.label[self.matched < 0], minlength=self.landmarks.accepts.shape[1])

    @cached_property
    def class_noise(self) -> Floats:
        """Ratio (L,) of the actual to the nominal noise of the rays of each class. With few rays, it is near 1."""
        labels, label = len(self.unassigned), self.label[self.owner]
        number = np.bincount(label, minlength=labels)
        middle = np.nan_to_num(grouped_median(self.deviation, label, labels)) / RAYLEIGH_MEDIAN
        return np.clip((number * middle + POOLED_WITH_CLASS) / (number + POOLED_WITH_CLASS), *NOISE_FACTORS)

    @cached_property
    def noise(self) -> Floats:
        """Ratio (N,) of the actual to the nominal noise of each landmark's rays. With few rays, it is near the ratio of the
        class."""
        middle = np.nan_to_num(grouped_median(self.deviation, self.owner, self.count)) / RAYLEIGH_MEDIAN
        own, number = np.minimum(middle, NOISE_FACTORS[1]), self.ray_count
        pooled = number * own + POOLED_WITH_CLASS * self.class_noise[self.label]
        return np.clip(pooled / (number + POOLED_WITH_CLASS), *NOISE_FACTORS)

    @cached_property
    def size(self) -> Floats:
        """Size (N,) m of each landmark: the median, over its boxes, of the geometric mean of width and height. 0 without
        boxes."""
        size = np.sqrt(self.obs.size[self.assigned].prod(axis=1)) * self.distance
        return np.nan_to_num(grouped_median(size, self.owner, self.count))

    @cached_property
    def ray_sigma(self) -> Floats:
        """Median standard deviation (N,) m of the offsets between each landmark and its rays. 0 without rays."""
        return np.nan_to_num(grouped_median(np.sqrt(self.variance), self.owner, self.count))

    @cached_property
    def history(self) -> DetectionHistory:
        """Detections and missed detections of the landmarks."""
        return detection_history(self.obs, self.matched, self.landmarks.position, self.label, self.view)

    @cached_property
    def looks(self) -> Looks | None:
        """What the landmarks look like, None if this was not learnt."""
        return None if self.ratio is None else Looks.of(self.obs, self.matched, self.count, self.ratio)

    def keep(self, which: Bools) -> State:
        """Keep the landmarks in the mask `which` (N,), and unassign the rays of all others."""
        if which.all():
            return self
        number = np.append(np.cumsum(which) - 1, -1)
        matched = np.where(np.append(which, False)[self.matched], number[self.matched], -1)
        return replace(self, landmarks=self.landmarks.take(which), matched=matched)

    def joined(self, other: State) -> State:
        """Return the landmarks of this state, followed by the landmarks of another state with the same rays. A ray with a
        landmark in both states keeps the landmark of this state."""
        matched = np.where((self.matched < 0) & (other.matched >= 0), other.matched + self.count, self.matched)
        return replace(self, landmarks=self.landmarks.and_also(other.landmarks), matched=matched)

    def merge(self, target: Ints) -> State:
        """Merge each landmark into the landmark `target` (N,). A landmark whose target is its own index stays."""
        accepts = np.zeros_like(self.landmarks.accepts)
        np.logical_or.at(accepts, target, self.landmarks.accepts)
        landmarks, matched = replace(self.landmarks, accepts=accepts), np.append(target, -1)[self.matched]
        return replace(self, landmarks=landmarks, matched=matched).keep(target == np.arange(len(target)))

    def split(self, which: Ints, second: Bools, position: Floats) -> State:
        """Split each landmark in `which` (S,) in two. The second part comes after all landmarks. It gets the rays of the
        landmark that are in the mask `second` (R,). position: (S, 2, 3) m, the positions of the two parts."""
        number = np.full(self.count + 1, -1)
        number[which] = self.count + np.arange(len(which))
        moved = self.landmarks.position.copy()
        moved[which] = position[:, 0]
        new = replace(self.landmarks.take(which), position=position[:, 1])
        landmarks = replace(self.landmarks, position=moved).and_also(new)
        matched = np.where(second & (number[self.matched] >= 0), number[self.matched], self.matched)
        return replace(self, landmarks=landmarks, matched=matched)
