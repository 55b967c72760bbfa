"""Boxes that are no landmark's yet: tracked from frame to frame until their parallax carries a place."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

from objslam.association.sightings import Sightings
from objslam.config import Settings
from objslam.graph.incremental import IncrementalGraph
from objslam.live.meeting import Meeting, information, meet, misses, sightings
from objslam.types import Floats, Ints

_DEPTH, _DEPTH_SIGMA = 2.5, 2.0  # m; where an object is taken to be that has been seen from one place only
_AGAIN = 1.2  # times as many rays, or as wide a spread, as when it was last tried, before it is tried again
_EARLY, _SURE = 0.4, 0.05  # share of the least parallax that is enough for a place this sure, as a share of its distance
_AGREE = 0.7  # share of the rays of a track that must agree, and of those that merely share a label
_AGREE_BY_LABEL = 0.5
_SLACK = 0.02  # m; the poses of one stretch fit each other that well
_STEPS, _CAUCHY = 3, 6.0  # of the first guess, and squared deviations at which a ray counts half in it
_RECENT = 30  # rays that a first guess is made of
_LONGEST = 200  # rays that a candidate keeps: the older ones of a longer one are thinned


@dataclass(eq=False)
class Candidate:
    """Rays of one thing: number of each ray, its keyframe, direction (3,) in the camera, sigma, range, range_sigma.

    position (3,) and covariance (3, 3): a first guess in map, from the rays as they lay when they came. drift: (6, 6)
    gathered when it was last seen. by_label: its rays share nothing but the label, and it waits as long as it takes.
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
    spread: float = 0.0
    tried_spread: float = 0.0
    _ahead: Floats | None = None
    _lines: list[Floats] = field(default_factory=list)

    def __len__(self) -> int:
        return len(self.rays)

    def numbers(self) -> Ints:
        """The numbers of its rays."""
        return np.array([ray[0] for ray in self.rays], dtype=np.int64)

    def extend(self, ray: tuple[int, int, Floats, float, float, float], map_T_camera: Floats) -> None:
        """One more ray, from a camera that is taken to be there; of very many, the older ones are left out alternately."""
        self.rays.append(ray)
        if len(self.rays) > _LONGEST:
            half = len(self.rays) // 2
            self.rays = self.rays[:half:2] + self.rays[half:]
        _, _, direction, sigma, range_, range_sigma = ray
        origin, n = map_T_camera[:3, 3], map_T_camera[:3, :3] @ direction
        if self._ahead is None:
            self._ahead = n
            self.position = origin + (range_ if np.isfinite(range_) else _DEPTH) * n
        self.spread = max(self.spread, math.acos(min(1.0, float(n @ self._ahead))))
        self._lines = [*self._lines[1 - _RECENT :], np.array([*origin, *n, sigma, range_, range_sigma])]

    def sight(self, graph: IncrementalGraph) -> Sightings:
        """Its rays in map, as the graph has the poses now."""
        _, keyframe, direction, sigma, range_, range_sigma = zip(*self.rays, strict=True)
        poses = np.array([graph.pose(k) for k in keyframe])
        ahead = np.einsum("rij,rj->ri", poses[:, :3, :3], np.array(direction))
        return sightings(poses[:, :3, 3], ahead, np.array(sigma), np.array(range_), np.array(range_sigma))

    def move(self, new_T_old: Floats) -> None:
        """Put it where the map has been moved to by a pose (4, 4)."""
        turn = new_T_old[:3, :3]
        self.position = turn @ self.position + new_T_old[:3, 3]
        self.covariance = turn @ self.covariance @ turn.T
        self._ahead = None if self._ahead is None else turn @ self._ahead
        for line in self._lines:
            line[:3], line[3:6] = turn @ line[:3] + new_T_old[:3, 3], turn @ line[3:6]


def place(candidates: list[Candidate]) -> None:
    """Where candidates are, all at once: where the last of their rays meet; along these, what they do not tell stays."""
    if not candidates:
        return
    number = np.array([len(c._lines) for c in candidates])
    lines = np.concatenate([np.array(c._lines) for c in candidates])
    index, begin = np.repeat(np.arange(len(candidates)), number), np.cumsum(number) - number
    s = sightings(lines[:, :3], lines[:, 3:6], lines[:, 6], lines[:, 7], lines[:, 8])
    points = np.array([c.position for c in candidates])
    away = s.direction[np.cumsum(number) - 1]
    hold = away[:, :, None] * away[:, None, :] / _DEPTH_SIGMA**2 + 1e-3 * np.eye(3)
    for _ in range(_STEPS):
        off = np.minimum(misses(s, points[index]), 1e3)
        gain = information(s, points[index]) / (1 + off**2 / _CAUCHY)[:, None, None]
        to = points[index] - s.origin
        along = np.einsum("ri,ri->r", to, s.direction)
        beyond = np.where(np.isfinite(s.range), s.range - along, 0.0)
        target = (along + beyond)[:, None] * s.direction - to
        pull = np.add.reduceat(gain @ target[:, :, None], begin)
        points = points + np.linalg.solve(hold + np.add.reduceat(gain, begin), pull)[:, :, 0]
    total = hold + np.add.reduceat(information(s, points[index]), begin)
    for candidate, point, covariance in zip(candidates, points, np.linalg.inv(total), strict=True):
        candidate.position, candidate.covariance = point, covariance


def ripe(candidate: Candidate, graph: IncrementalGraph, settings: Settings, rng: np.random.Generator) -> Meeting | None:
    """Where a candidate is once its rays carry that: enough of them, enough parallax or ranges, few against it."""
    live = settings.live
    if len(candidate) < live.min_rays:
        return None
    if len(candidate) < _AGAIN * candidate.tried and candidate.spread < _AGAIN * candidate.tried_spread:
        return None
    ranged = any(np.isfinite(ray[4]) for ray in candidate.rays)
    if not ranged and candidate.spread < _EARLY * np.radians(settings.joint.min_parallax_deg):
        return None
    candidate.tried, candidate.tried_spread = len(candidate), candidate.spread
    share = _AGREE_BY_LABEL if candidate.by_label else _AGREE
    return carried_place(candidate.sight(graph), live.min_rays, share, settings, rng, early=True)


def carried_place(
    s: Sightings, least: int, share: float, settings: Settings, rng: np.random.Generator, early: bool = False
) -> Meeting | None:
    """Where rays meet if that makes an object: so many of them and such a share agree, with enough parallax or ranges.

    early: less parallax is enough for a place that is very sure.
    """
    met = meet(s, rng, _SLACK)
    if met is None or met.agree.sum() < least or met.agree.mean() < share:
        return None
    full = np.radians(settings.joint.min_parallax_deg)
    away = float(np.median(np.linalg.norm(met.position - s.origin[met.agree], axis=1)))
    sigma = np.sqrt(np.linalg.eigvalsh(met.covariance)[-1])
    if early and met.parallax >= _EARLY * full and sigma <= _SURE * away:
        return met
    wide = met.parallax >= full or bool(np.isfinite(s.range).any())
    return met if wide and sigma <= settings.triangulation.max_rel_sigma * away else None
