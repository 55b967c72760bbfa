"""Nearest-neighbour association: rays to known landmarks by predicted bearing, or every label as one object."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from objslam.association.gating import best_assignment, gate_limit, gated_edges
from objslam.association.landmarks import Landmarks
from objslam.association.observations import Observations
from objslam.association.refinement import RANGE_LOSS
from objslam.core.arrays import Bools, Floats, Ints
from objslam.core.types import Association, Rays


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
    """The landmark of each ray (R,), -1 none: in each frame the most likely choice, with at most one ray a landmark.

    A ray's range adds to the cost where it is known; a wrong one costs little.

    Args:
        positions: (N, 3) m, NaN for a landmark to leave out.
        covariances: (N, 3, 3) m^2.
        accepts: (N, L) whether a box of a label may be the landmark's.
        map_T_camera: (K, 4, 4) of the rays' keyframes.
        sigma: (R,) rad, and position_sigma: m, of the rays.
        pose_covariance: (K, 6, 6) of the cameras in their own frames, rotation first, as GTSAM's marginals are.
        gate: the share of right matches that the gate on the bearing lets through.
    """
    origin, direction = rays.in_map(map_T_camera)
    obs = Observations.of_lines(origin, direction, sigma, rays.range, rays.range_sigma, rays.label)
    obs = replace(obs, position_sigma=position_sigma)
    known = np.flatnonzero(np.isfinite(positions).all(axis=1) & np.isfinite(covariances).all(axis=(1, 2)))
    landmarks = Landmarks(positions[known], covariances[known], np.ones(len(known)), accepts[known])
    pose = None
    if pose_covariance is not None:
        turn = np.zeros((len(map_T_camera), 6, 6))
        turn[:, :3, :3] = turn[:, 3:, 3:] = map_T_camera[:, :3, :3]
        pose = (turn @ pose_covariance @ np.swapaxes(turn, 1, 2))[rays.keyframe]
    limit = gate_limit(gate)
    edges = gated_edges(obs, landmarks, limit, pose)
    chosen = best_assignment(
        edges, edges.cost, rays.keyframe, limit + RANGE_LOSS + float(edges.vague.max(initial=0.0)) + 1e-9
    )
    return np.where(chosen >= 0, known[chosen], -1) if len(known) else chosen


def associate_by_label(rays: Rays) -> Association:
    """One object for each label that has a ray, in the order of label_names.

    Of several boxes in a frame the one with the highest score counts, the first one of equals. The others have no object.
    """
    labels = np.unique(rays.label)
    best = np.lexsort((np.arange(len(rays)), -rays.score, rays.label, rays.keyframe))
    _, first = np.unique(np.stack([rays.keyframe[best], rays.label[best]]), axis=1, return_index=True)
    which = np.full(len(rays), -1, dtype=np.int64)
    chosen = best[first]
    which[chosen] = np.searchsorted(labels, rays.label[chosen])
    return Association(object=which, label=labels)
