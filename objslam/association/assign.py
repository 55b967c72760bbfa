"""New boxes to known landmarks: frame by frame, by predicted bearing and its covariance."""

from __future__ import annotations

import numpy as np

from objslam.association.landmarks import RANGE_LOSS, Landmarks
from objslam.association.matches import choose, gated_edges
from objslam.association.sightings import Sightings
from objslam.types import Bools, Floats, Ints, Rays


def assign(
    rays: Rays,
    positions: Floats,
    covariances: Floats,
    accepts: Bools,
    map_T_camera: Floats,
    sigma: Floats,
    *,
    position_sigma: float = 0.0,
    pose_covariance: Floats | None = None,
    gate: float = 0.999,
) -> Ints:
    """The landmark of each ray (R,), or -1: at most one ray a landmark and frame, the most likely choice in each frame.

    positions: (N, 3) m, NaN for a landmark to leave out; covariances: (N, 3, 3) m^2. accepts: (N, L) whether a box of a
    label may be the landmark's. map_T_camera: (K, 4, 4) of the rays' keyframes. sigma: (R,) rad, position_sigma: m, of the
    rays. pose_covariance: (K, 6, 6) of the cameras, rotation first, in the camera's own frame (GTSAM's marginals). gate: the
    share of right matches that the gate on the squared deviation of the bearing lets through (chi-squared, 2 degrees of
    freedom); a ray's range adds to the cost where it is known, and breaks nothing when it is wrong.
    """
    origin, direction = rays.in_map(map_T_camera)
    s = Sightings(
        frame=rays.keyframe,
        label=rays.label,
        origin=origin,
        direction=direction,
        sigma=sigma,
        place=position_sigma,
        range=rays.range,
        range_sigma=rays.range_sigma,
        size=np.zeros((len(rays), 2)),
        box=rays.box,
        track=rays.track_id,
        score=rays.score,
    )
    known = np.flatnonzero(np.isfinite(positions).all(axis=1) & np.isfinite(covariances).all(axis=(1, 2)))
    landmarks = Landmarks(positions[known], covariances[known], np.ones(len(known)), accepts[known])
    pose = None
    if pose_covariance is not None:
        turn = np.zeros((len(map_T_camera), 6, 6))
        turn[:, :3, :3] = turn[:, 3:, 3:] = map_T_camera[:, :3, :3]
        pose = (turn @ pose_covariance @ np.swapaxes(turn, 1, 2))[rays.keyframe]
    limit = gate_limit(gate)
    edges = gated_edges(s, landmarks, limit, pose)
    chosen = choose(edges, edges.cost, rays.keyframe, limit + RANGE_LOSS + float(edges.vague.max(initial=0.0)) + 1e-9)
    return np.where(chosen >= 0, known[chosen], -1) if len(known) else chosen


def gate_limit(share: float) -> float:
    """The squared deviation of a bearing below which this share of right matches lies."""
    return float(-2 * np.log1p(-share))  # chi-squared with 2 degrees of freedom in closed form
