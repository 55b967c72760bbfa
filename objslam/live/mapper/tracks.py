"""Tracks: boxes of one object over several frames, before their parallax is enough for a landmark."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from objslam.association.observations import Observations
from objslam.association.refinement import refine_damped
from objslam.core.arrays import Floats, Ints
from objslam.graph.isam2 import IncrementalGraph

_DEPTH = 2.5  # The first guess of a track's distance (m) without a range: about the middle of a room.
_DEPTH_SIGMA = 2.0  # The prior's sigma (m) of a track along its last ray. With a larger sigma, rays move it more.
_DAMPING = 1e-3  # The prior's information (m^-2) in all directions. With a larger value, rays move the track less.
_STEPS = 3  # The Gauss-Newton steps from a track's previous position, which is near. More steps take longer in every frame.
_RECENT = 30  # The newest rays that define a track's position. More rays average noise better, but span more drift.
_LONGEST = 200  # The most rays of a track. Above it, every second ray of the older half is dropped. More rays cost memory.

TrackRay = tuple[int, int, Floats, float, float, float]
"""One ray of a track: its number, its keyframe, its direction (3,) in the camera frame, sigma in rad, range and range_sigma
in m."""


@dataclass(eq=False)
class Track:
    """The rays of one object that is not a landmark yet.

    label: the number of its label. by_label: whether its rays were grouped by label alone. first, last: stamps, s, of its
    first and last observation. drift: (6, 6) odometry drift at the last observation. position: (3,) m and covariance: (3, 3)
    m^2 are in the frame map, by the camera poses at the last observation. spread: rad, the widest angle between a ray and
    the first ray. tried, tried_spread: the number of rays and the spread at the last attempt to make a landmark.
    """

    id: int
    label: int
    by_label: bool
    first: float
    last: float
    drift: Floats
    position: Floats = field(default_factory=lambda: np.zeros(3))
    covariance: Floats = field(default_factory=lambda: np.eye(3))
    rays: list[TrackRay] = field(default_factory=list)
    tried: int = 0
    spread: float = 0.0
    tried_spread: float = 0.0
    _ahead: Floats | None = None

    def numbers(self) -> Ints:
        """Return the numbers of the track's rays."""
        return np.array([ray[0] for ray in self.rays], dtype=np.int64)

    def extend(self, ray: TrackRay, map_T_camera: Floats, stamp: float, drift: Floats) -> None:
        """Add a ray from a camera pose (4, 4). drift: (6, 6) odometry drift at the stamp."""
        self.rays.append(ray)
        self.last, self.drift = max(self.last, stamp), drift
        if len(self.rays) > _LONGEST:
            half = len(self.rays) // 2
            self.rays = self.rays[:half:2] + self.rays[half:]
        _, _, direction, _, range_, _ = ray
        origin, n = map_T_camera[:3, 3], map_T_camera[:3, :3] @ direction
        if self._ahead is None:
            self._ahead = n
            self.position = origin + (range_ if np.isfinite(range_) else _DEPTH) * n
        self.spread = max(self.spread, math.acos(min(1.0, float(n @ self._ahead))))

    def sight(self, graph: IncrementalGraph) -> Observations:
        """Return the rays of the track in the frame map, by the current camera poses of the graph."""
        return _in_map(self.rays, graph)

    def remeasure(self, directions: Floats, ranges: Floats, range_sigmas: Floats, drift: Floats) -> None:
        """Replace directions (n, 3), ranges (n,) and their sigmas (n,), and drift (6, 6), after a calibration."""
        self.rays = [
            (number, k, direction, sigma, float(reach), float(range_sigma))
            for (number, k, _, sigma, _, _), direction, reach, range_sigma in zip(
                self.rays, directions, ranges, range_sigmas, strict=True
            )
        ]
        self.drift = drift

    def move(self, new_T_old: Floats) -> None:
        """Move the track's position and covariance in the frame map by a pose (4, 4)."""
        turn = new_T_old[:3, :3]
        self.position = turn @ self.position + new_T_old[:3, 3]
        self.covariance = turn @ self.covariance @ turn.T
        self._ahead = None if self._ahead is None else turn @ self._ahead


def update_positions(tracks: Sequence[Track], graph: IncrementalGraph) -> None:
    """Triangulate the newest rays of all tracks in one batch, with their previous positions as weak priors.

    The rays begin at the current camera poses of the graph. The predicted pose of a frame may be wrong by more than the
    noise of a ray, until later measurements correct this pose. So rays from predicted poses would not meet.
    """
    if not tracks:
        return
    newest = [track.rays[-_RECENT:] for track in tracks]
    number = np.array([len(rays) for rays in newest])
    obs = _in_map([ray for rays in newest for ray in rays], graph)
    away = obs.direction[np.cumsum(number) - 1]
    damping = away[:, :, None] * away[:, None, :] / _DEPTH_SIGMA**2 + _DAMPING * np.eye(3)
    positions, covariances = refine_damped(obs, number, np.array([t.position for t in tracks]), damping, _STEPS)
    for track, position, covariance in zip(tracks, positions, covariances, strict=True):
        track.position, track.covariance = position, covariance


def _in_map(rays: Sequence[TrackRay], graph: IncrementalGraph) -> Observations:
    """Return rays in the frame map, by the current camera poses of the graph."""
    _, keyframe, direction, sigma, range_, range_sigma = zip(*rays, strict=True)
    ids, index = np.unique(keyframe, return_inverse=True)
    poses = np.array([graph.pose(k) for k in ids.tolist()])[index]
    ahead = np.einsum("rij,rj->ri", poses[:, :3, :3], np.array(direction))
    return Observations.of_lines(poses[:, :3, 3], ahead, np.array(sigma), np.array(range_), np.array(range_sigma))
