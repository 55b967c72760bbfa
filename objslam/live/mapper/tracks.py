"""Boxes that are no landmark's yet: tracked from frame to frame until their parallax carries a place."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from objslam.association.observations import Observations
from objslam.association.refinement import refine_damped
from objslam.core.arrays import Floats, Ints
from objslam.graph.isam2 import IncrementalGraph

_DEPTH = 2.5
"""m; how far away a thing is taken to be that was seen from one place only, about the middle of a room."""
_DEPTH_SIGMA = 2.0
"""Standard deviation of that, m; larger leaves a track's place along its last ray to its rays alone."""
_DAMPING = 1e-3
"""Information, m^-2, that a track's place stays where it was in all directions; larger moves it more slowly."""
_STEPS = 3
"""Steps of Gauss-Newton to a track's place, which is near to where it was before; more take longer in every frame."""
_RECENT = 30
"""Rays that a track's place is made of; more average more noise, over a longer stretch of drift."""
_LONGEST = 200
"""Rays that a track keeps, the older ones of a longer one left out in turns; more cost memory and time."""


@dataclass(eq=False)
class Track:
    """Rays of one thing that is no landmark yet.

    Attributes:
        by_label: whether its rays share nothing but the label; then it waits as long as it takes.
        first, last: stamps, s, at which it was seen.
        drift: (6, 6) covariance that the odometry had gathered when it was last seen.
        position, covariance: (3,) m and (3, 3) m^2, a first guess in map from the rays as they lay when they came.
        rays: of each its number, its keyframe, direction (3,) in the camera, sigma rad, range m, range_sigma m.
        spread: rad, the widest angle between a ray and the first one.
        tried, tried_spread: how many rays there were, and their spread, when it was last tried to make a landmark of them.
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

    def numbers(self) -> Ints:
        """The numbers of its rays."""
        return np.array([ray[0] for ray in self.rays], dtype=np.int64)

    def extend(
        self, ray: tuple[int, int, Floats, float, float, float], map_T_camera: Floats, stamp: float, drift: Floats
    ) -> None:
        """One more ray, from a camera at that pose; of very many rays, every second of the older half is left out."""
        self.rays.append(ray)
        self.last, self.drift = max(self.last, stamp), drift
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

    def sight(self, graph: IncrementalGraph) -> Observations:
        """Its rays in map, as the graph has the poses now."""
        _, keyframe, direction, sigma, range_, range_sigma = zip(*self.rays, strict=True)
        poses = np.array([graph.pose(k) for k in keyframe])
        ahead = np.einsum("rij,rj->ri", poses[:, :3, :3], np.array(direction))
        return Observations.of_lines(poses[:, :3, 3], ahead, np.array(sigma), np.array(range_), np.array(range_sigma))

    def move(self, new_T_old: Floats) -> None:
        """Put it where the map has been moved to by a pose (4, 4)."""
        turn = new_T_old[:3, :3]
        self.position = turn @ self.position + new_T_old[:3, 3]
        self.covariance = turn @ self.covariance @ turn.T
        self._ahead = None if self._ahead is None else turn @ self._ahead
        for line in self._lines:
            line[:3], line[3:6] = turn @ line[:3] + new_T_old[:3, 3], turn @ line[3:6]


def update_positions(tracks: Sequence[Track]) -> None:
    """Where tracks are, all at once: where the last of their rays meet; along these, what they do not tell stays."""
    if not tracks:
        return
    number = np.array([len(t._lines) for t in tracks])
    lines = np.concatenate([np.array(t._lines) for t in tracks])
    obs = Observations.of_lines(lines[:, :3], lines[:, 3:6], lines[:, 6], lines[:, 7], lines[:, 8])
    away = obs.direction[np.cumsum(number) - 1]
    damping = away[:, :, None] * away[:, None, :] / _DEPTH_SIGMA**2 + _DAMPING * np.eye(3)
    positions, covariances = refine_damped(obs, number, np.array([t.position for t in tracks]), damping, _STEPS)
    for track, position, covariance in zip(tracks, positions, covariances, strict=True):
        track.position, track.covariance = position, covariance
