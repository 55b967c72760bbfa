"""Match rays to known landmarks by their predicted bearings (nearest neighbour), or make one object of each label."""

import numpy as np

from objslam.association.appearance.evidence import Looks
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
    pose_covariance: Floats | None = None,
    gate: float = 0.999,
    looks: Looks | None = None,
) -> Ints:
    """Return the most likely landmark (R,) of each ray, -1 for none. A landmark gets at most one ray per frame.

    A measured range changes the cost of a match. A wrong range adds at most `RANGE_LOSS`.

    Args:
        positions: (N, 3) m, NaN to leave a landmark out. covariances: (N, 3, 3) m^2, of the positions.
        accepts: (N, L) whether a box of a label may belong to the landmark.
        map_T_camera: (K, 4, 4) the camera poses of the rays' keyframes. sigma: (R,) rad, noise of the rays.
        pose_covariance: (K, 6, 6) of the camera poses, in camera coordinates, rotation first (GTSAM's marginals).
        gate: the share of correct matches that the bearing gate accepts.
        looks: what the landmarks look like, None if this is not known.
    """
    origin, direction = rays.in_map(map_T_camera)
    obs = Observations.of_lines(origin, direction, sigma, rays.range, rays.range_sigma, rays.label)
    known = np.flatnonzero(np.isfinite(positions).all(axis=1) & np.isfinite(covariances).all(axis=(1, 2)))
    landmarks = Landmarks(positions[known], covariances[known], np.ones(len(known)), accepts[known])
    pose = None
    if pose_covariance is not None:
        turn = np.zeros((len(map_T_camera), 6, 6))
        turn[:, :3, :3] = turn[:, 3:, 3:] = map_T_camera[:, :3, :3]
        pose = (turn @ pose_covariance @ np.swapaxes(turn, 1, 2))[rays.keyframe]
    limit = gate_limit(gate)
    edges = gated_edges(obs, landmarks, limit, pose)
    unmatched = limit + RANGE_LOSS + float(edges.vague.max(initial=0.0)) + 1e-9
    cost = edges.cost
    if looks is not None:
        mine = np.zeros(len(cost), dtype=bool)
        cost = cost - 2 * looks.ray_odds(rays, edges.ray, known[edges.landmark], mine)
    chosen = best_assignment(edges, cost, rays.keyframe, unmatched)
    return np.where(chosen >= 0, known[chosen], -1) if len(known) else chosen


def associate_by_label(rays: Rays, off: Floats | None = None) -> Association:
    """Make one object for each label with a ray, in the order of label_names.

    In each frame, one box of each label gets the object: the nearest one if `off` is given, else the box with the highest
    score. If scores are equal, the first box wins. All other boxes get no object. off: (R,) the angle between each ray and
    the object of its label, NaN if it is not known.
    """
    labels = np.unique(rays.label)
    far = np.zeros(len(rays)) if off is None else np.where(np.isfinite(off), off, np.inf)
    best = np.lexsort((np.arange(len(rays)), -rays.score, far, rays.label, rays.keyframe))
    _, first = np.unique(np.stack([rays.keyframe[best], rays.label[best]]), axis=1, return_index=True)
    which = np.full(len(rays), -1, dtype=np.int64)
    which[best[first]] = np.searchsorted(labels, rays.label[best[first]])
    return Association(object=which, label=labels)
