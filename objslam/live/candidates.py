"""Boxes that are no landmark's yet: tracked from frame to frame until their parallax carries a place."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from objslam.association.refit import refit
from objslam.association.sightings import Sightings
from objslam.config import Settings
from objslam.graph.incremental import IncrementalGraph
from objslam.live.meeting import Meeting, information, meet, sightings
from objslam.types import Floats, Ints

_DEPTH, _DEPTH_SIGMA = 2.5, 2.0  # m; where an object is taken to be that has been seen from one place only
_AGAIN = 1.3  # times as many rays as when it was last tried, before it is tried again
_AGREE = 0.7  # share of the rays of a track that must agree, and of those that merely share a label
_AGREE_BY_LABEL = 0.5
_SLACK = 0.02  # m; the poses of one stretch fit each other that well
_LONGEST = 200  # rays that a candidate keeps: the older ones of a longer one are thinned


@dataclass
class Candidate:
    """Rays of one thing: number of each ray, its keyframe, direction (3,) in the camera, sigma, range, range_sigma.

    position (3,) and covariance (3, 3): a first guess in map. drift: (6, 6) gathered when it was last seen. by_label: its
    rays share nothing but the label, and it waits as long as it takes.
    """

    id: int
    label: int
    by_label: bool
    first: float
    last: float
    drift: Floats
    position: Floats = field(default_factory=lambda: np.zeros(3))
    covariance: Floats = field(default_factory=lambda: np.eye(3))
    rays: list[tuple[int, int, Floats, float, float, float]] = field(default_factory=list)
    tried: int = 0

    def __len__(self) -> int:
        return len(self.rays)

    def numbers(self) -> Ints:
        """The numbers of its rays."""
        return np.array([ray[0] for ray in self.rays], dtype=np.int64)

    def keyframes(self) -> Ints:
        """The keyframe of each ray."""
        return np.array([ray[1] for ray in self.rays], dtype=np.int64)

    def thin(self) -> None:
        """At most so many rays, the older ones left out alternately."""
        if len(self.rays) > _LONGEST:
            half = len(self.rays) // 2
            self.rays = self.rays[:half:2] + self.rays[half:]

    def sight(self, graph: IncrementalGraph) -> Sightings:
        """Its rays in map, as the graph has the poses now."""
        _, keyframe, direction, sigma, range_, range_sigma = zip(*self.rays, strict=True)
        poses = np.array([graph.pose(k) for k in keyframe])
        ahead = np.einsum("rij,rj->ri", poses[:, :3, :3], np.array(direction))
        return sightings(poses[:, :3, 3], ahead, np.array(sigma), np.array(range_), np.array(range_sigma))

    def guess(self, graph: IncrementalGraph) -> None:
        """Place it: where its rays meet if they do, else at a usual distance on the last one."""
        s = self.sight(graph)
        last = len(s) - 1
        depth = s.range[last] if np.isfinite(s.range[last]) else _DEPTH
        if len(s) == 1:
            self.position = s.origin[last] + depth * s.direction[last]
        else:
            everything = np.arange(len(s))
            self.position = refit(s, everything, 0 * everything, self.position[None], np.ones(1))[0]
        n = s.direction[last]
        along = np.outer(n, n) / _DEPTH_SIGMA**2
        self.covariance = np.linalg.inv(information(s, self.position).sum(axis=0) + along + 1e-3 * np.eye(3))


def ripe(candidate: Candidate, graph: IncrementalGraph, settings: Settings, rng: np.random.Generator) -> Meeting | None:
    """Where a candidate is once its rays carry that: enough of them, enough parallax or ranges, and hardly one against it."""
    live = settings.live
    if len(candidate) < max(live.min_rays, _AGAIN * candidate.tried):
        return None
    s = candidate.sight(graph)
    ranged = bool(np.isfinite(s.range).any())
    least = np.radians(settings.joint.min_parallax_deg)
    if not ranged and not _spread(s.direction) >= least:
        return None
    candidate.tried = len(candidate)
    met = meet(s, rng, _SLACK)
    if met is None or met.agree.sum() < live.min_rays or (met.parallax < least and not ranged):
        return None
    if met.agree.mean() < (_AGREE_BY_LABEL if candidate.by_label else _AGREE):
        return None
    away = float(np.median(np.linalg.norm(met.position - s.origin[met.agree], axis=1)))
    surely = np.sqrt(np.linalg.eigvalsh(met.covariance)[-1]) <= settings.triangulation.max_rel_sigma * away
    return met if surely else None


def _spread(direction: Floats) -> float:
    """An upper bound on the parallax of directions (R, 3): twice the widest angle off the first."""
    return 2 * float(np.arccos(np.clip(direction @ direction[0], -1.0, 1.0)).max())
