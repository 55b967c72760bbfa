"""Every factor that is to be in a growing graph, by what it belongs to."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple

import gtsam
import numpy as np

from objslam.config import Settings
from objslam.graph import factors
from objslam.types import Floats, Ints

_EQ1_SIGMA, _L1_RADIANS = 0.05, 1e-4  # as `grow` has them


@dataclass(frozen=True)
class Bearings:
    """Rays for the graph: number (n,) of their own, keyframe (n,), landmark (n,), direction (n, 3) in the camera, sigma (n,)
    rad, range (n,) m or NaN, range_sigma (n,) m."""

    number: Ints
    keyframe: Ints
    landmark: Ints
    direction: Floats
    sigma: Floats
    range: Floats
    range_sigma: Floats


class KeptRay(NamedTuple):
    """The factors of a ray of X(keyframe) to L(landmark)."""

    keyframe: int
    landmark: int
    factors: list[gtsam.NonlinearFactor]


@dataclass
class Kept:
    """Motions by the keyframe that they lead to, absolute poses by keyframe, rays by their number, priors by landmark."""

    chain: dict[int, gtsam.NonlinearFactor] = field(default_factory=dict)
    absolute: dict[int, gtsam.NonlinearFactor] = field(default_factory=dict)
    rays: dict[int, KeptRay] = field(default_factory=dict)
    landmarks: dict[int, gtsam.NonlinearFactor] = field(default_factory=dict)

    def graph(self) -> gtsam.NonlinearFactorGraph:
        """All of them."""
        graph = gtsam.NonlinearFactorGraph()
        for group in (self.chain, self.absolute, self.landmarks):
            for factor in group.values():
                graph.push_back(factor)
        for ray in self.rays.values():
            for factor in ray.factors:
                graph.push_back(factor)
        return graph

    def copy(self) -> Kept:
        """The same factors, in tables of their own."""
        return Kept(dict(self.chain), dict(self.absolute), dict(self.rays), dict(self.landmarks))


def ray_groups(rays: Bearings, settings: Settings) -> list[list[gtsam.NonlinearFactor]]:
    """The factors of each ray: bearing or point-to-line as set, and its range where it has one."""
    if settings.joint.factor == "bearing":
        noise = factors.robust("huber", rays.sigma, 2, _L1_RADIANS)
        groups = [[f] for f in factors.bearing(rays.keyframe, rays.direction, rays.landmark, noise)]
    else:
        noise = factors.robust("huber", np.full(len(rays.number), _EQ1_SIGMA), 2)
        groups = [[f] for f in factors.point_to_line(rays.keyframe, rays.direction, rays.landmark, noise)]
    ranged = np.flatnonzero(np.isfinite(rays.range))
    if len(ranged):
        noise = factors.robust("cauchy", rays.range_sigma[ranged], 1)
        found = factors.ranges(rays.keyframe[ranged], rays.range[ranged], rays.landmark[ranged], noise)
        for i, factor in zip(ranged.tolist(), found, strict=True):
            groups[i].append(factor)
    return groups
