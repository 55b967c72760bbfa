"""The boxes of one frame to landmarks and tracks: predicted bearing, its covariance, a gate, and the best assignment."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from objslam.association.gating import TRACK_GAIN, Edges, gate_limit, gated_edges, pair_up
from objslam.association.joint_compatibility import jointly_compatible, unknown_density
from objslam.association.landmarks import Landmarks, PredictedLandmarks
from objslam.association.observations import Observations
from objslam.association.refinement import RANGE_LOSS
from objslam.core.arrays import Bools, Floats, Ints
from objslam.live.mapper.landmark_table import LandmarkTable, covariances, noise
from objslam.live.mapper.pose_uncertainty import PoseUncertainty, long_unseen

_VIEW = np.cos(np.radians(40.0))
"""Cosine of the angle; landmarks further off every box of a frame are not looked at. Larger angles only take time."""
_BEYOND = 1.5
"""Times the greatest distance from which anything was seen; what is further away is not looked at."""
_NEAR = 10.0
"""m; what is no further away than this is looked at in any case."""
_ROUGH = 3.0
"""Times the noise of a ray; a bearing that is predicted less well is rough. Larger trusts more single boxes."""
_CLEAR = 6.0
"""Squared deviations by which the best of several places that are all rough must be better; larger leaves more undecided."""
_WIDEST = 0.3
"""m; a place that is rougher than that tells no landmark from another. Larger trusts more single boxes."""
_BY_LABEL = 4.0
"""Times the gate, where only one object has the label; larger keeps more rays of an object whose pose has drifted."""


@dataclass(frozen=True)
class FrameRays:
    """The usable boxes of one frame.

    direction: (n, 3) unit, in the camera. sigma: (n,) rad. range, range_sigma: (n,) m, NaN where unknown. label: (n,) its
    number. score: (n,). box: (n, 4) px. track: (n,) of the detector, -1 where unknown.
    """

    direction: Floats
    sigma: Floats
    range: Floats
    range_sigma: Floats
    label: Ints
    score: Floats
    box: Floats
    track: Ints

    def take(self, rays: Ints) -> FrameRays:
        """Some of them (m,)."""
        return FrameRays(**{name: value[rays] for name, value in vars(self).items()})


def match(
    rays: FrameRays,
    map_T_camera: Floats,
    predicted: PredictedLandmarks,
    uncertainty: PoseUncertainty,
    labels: int,
    gate: float,
    landmark_of_track: Mapping[int, int],
    novelty: float = 1.0,
) -> Ints:
    """For each ray (n,) which of the predicted landmarks and tracks it is of, or -1.

    Tracks that were long unseen are none of them, unless the camera's place is known well.

    Args:
        rays: (n,) of one frame.
        map_T_camera: (4, 4) pose that is predicted for its camera, and how well by `uncertainty`.
        predicted: landmarks and tracks.
        labels: how many labels there are.
        gate: share of right matches that pass.
        landmark_of_track: id of the landmark that a track of the detector was given last.
        novelty: share of boxes that showed nothing known, of late.
    """
    obs, origin, count = in_map(rays, map_T_camera), map_T_camera[:3, 3], len(rays.label)
    unseen = long_unseen(uncertainty.drift, predicted.drift)
    rows = _possible(obs, origin, predicted, uncertainty, unseen, labels)
    if not len(rows):
        return np.full(count, -1, dtype=np.int64)
    landmark, own, then = rows < predicted.landmarks, predicted.covariance[rows], predicted.drift[rows]
    places, noises = predicted.position[rows], predicted.noise[rows]
    to = places - origin
    accepts = predicted.label[rows][:, None] == np.arange(labels)
    limit = gate_limit(gate)
    spread = own + uncertainty.of_landmarks(to, then, map_T_camera)
    edges = gated_edges(obs, Landmarks(places, spread, noises, accepts), limit)
    edges = _clear(edges, rays.sigma, to, landmark)
    cost = edges.cost
    if landmark_of_track and (rays.track >= 0).any():
        before = np.array([landmark_of_track.get(t, -1) for t in rays.track.tolist()])
        cost = cost - np.where(before[edges.ray] == predicted.id[rows][edges.landmark], TRACK_GAIN, 0.0)
    unmatched = limit + RANGE_LOSS + float(edges.vague.max(initial=0.0)) + 1e-9
    chosen = _best(edges, cost, count, len(places), unmatched)
    unseen = unseen[rows] & landmark
    back = np.flatnonzero((chosen >= 0) & unseen[chosen])
    if len(back):
        at, some = chosen[back], obs.take(back)
        again = Landmarks(places[at], own[at], noises[at], accepts[at])
        unknown = unknown_density(some, rows[at], predicted, novelty)
        sure = back[jointly_compatible(some, again, uncertainty.against(to[at], then[at]), map_T_camera, unknown)]
        if len(sure) < len(back):  # what is best of all stays so without what was not chosen
            keep = ~unseen[edges.landmark] | (np.isin(edges.ray, sure) & (chosen[edges.ray] == edges.landmark))
            chosen = _best(_some(edges, keep), cost[keep], count, len(places), unmatched)
    return np.where(chosen >= 0, rows[chosen], -1)


def match_by_label(
    rays: FrameRays, map_T_camera: Floats, landmarks: LandmarkTable, uncertainty: PoseUncertainty, gate: float
) -> tuple[Ints, Ints]:
    """As `match`, where every label is one object and no label comes twice.

    Returns:
        the row (n,) of each ray's landmark or -1, and the row (n,) of the landmark of its label that it misses or -1.
    """
    rows = np.flatnonzero(np.isin(landmarks.label, rays.label))
    hit, missed = (np.full(len(rays.label), -1, dtype=np.int64) for _ in range(2))
    if not len(rows):
        return hit, missed
    position = landmarks.position[rows]
    moved = uncertainty.of_landmarks(position - map_T_camera[:3, 3], landmarks.drift[rows], map_T_camera)
    accepts = landmarks.label[rows][:, None] == np.arange(int(max(rays.label.max(), landmarks.label.max())) + 1)
    places = Landmarks(position, covariances(landmarks, rows) + moved, noise(landmarks, rows), accepts)
    edges = gated_edges(in_map(rays, map_T_camera), places, _BY_LABEL * gate_limit(gate))
    hit[edges.ray] = rows[edges.landmark]
    for i in np.flatnonzero(hit < 0).tolist():
        same = rows[landmarks.label[rows] == rays.label[i]]
        missed[i] = same[0] if len(same) else -1
    return hit, missed


def best_of_label(rays: FrameRays) -> Ints:
    """Indices of the rays (m,) that have the highest score of their label."""
    order = np.lexsort((np.arange(len(rays.label)), -rays.score, rays.label))
    _, first = np.unique(rays.label[order], return_index=True)
    return np.sort(order[first])


def in_map(rays: FrameRays, map_T_camera: Floats, which: Ints | slice = slice(None)) -> Observations:
    """The rays, or some of them, as lines in map."""
    direction = rays.direction[which] @ map_T_camera[:3, :3].T
    origin = np.broadcast_to(map_T_camera[:3, 3], direction.shape)
    return Observations.of_lines(
        origin, direction, rays.sigma[which], rays.range[which], rays.range_sigma[which], rays.label[which]
    )


def _possible(
    obs: Observations,
    origin: Floats,
    predicted: PredictedLandmarks,
    uncertainty: PoseUncertainty,
    unseen: Bools,
    labels: int,
) -> Ints:
    """Which of the predicted (n,) the rays from one origin (3,) could show; unseen: (n,) which are long unseen."""
    shown = np.zeros(labels + 1, dtype=bool)  # the last one is that of label -1
    shown[obs.label] = True
    wanted = np.flatnonzero(shown[predicted.label])
    to = predicted.position[wanted] - origin
    distance = np.sqrt((to * to).sum(axis=1))
    ahead = (to @ obs.direction.T).max(axis=1, initial=-np.inf) > _VIEW * distance
    ahead &= distance < max(_BEYOND * predicted.far, _NEAR)
    of_track = wanted >= predicted.landmarks
    left = of_track & unseen[wanted]
    if left.any() and uncertainty.is_placed:
        left[:] = False
    return wanted[np.where(of_track, ~left, ahead)]


def _best(edges: Edges, cost: Floats, rays: int, places: int, unmatched: float) -> Ints:
    """The place of each ray (n,) of one frame, -1 none, with the least total cost: `best_assignment` for one frame."""
    useful = np.flatnonzero(cost < unmatched)
    ray, place = pair_up(edges.ray[useful], edges.landmark[useful], unmatched - cost[useful], (rays, places))
    chosen = np.full(rays, -1, dtype=np.int64)
    chosen[ray] = place
    return chosen


def _some(edges: Edges, keep: Bools) -> Edges:
    return Edges(edges.ray[keep], edges.landmark[keep], edges.deviation[keep], edges.vague[keep], edges.cost[keep])


def _clear(edges: Edges, sigma: Floats, to: Floats, landmark: Bools) -> Edges:
    """Without the matches to landmarks that are expected only roughly, where it could as well be another.

    Where no place at all is expected, a single box tells nothing: several landmarks must tell together (`loop_closure`).
    to: (N, 3) m, the way to each place. landmark: (N,) whether it is one.
    """
    rough = (edges.vague > 2 * np.log(_ROUGH)) & landmark[edges.landmark]
    if not rough.any():
        return edges
    away = np.linalg.norm(to[edges.landmark], axis=1)
    width = sigma[edges.ray] * away * np.exp(edges.vague / 4)  # the side of a square as large as what the landmark covers
    order = np.lexsort((edges.cost, edges.ray))
    ray, cost = edges.ray[order], edges.cost[order]
    rivals = np.flatnonzero((np.diff(ray) == 0) & (np.diff(cost) < _CLEAR) & (np.diff(ray, prepend=-1)[:-1] != 0)) + 1
    both = rough[order[rivals]] & rough[order[rivals - 1]]
    return _some(edges, ~(rough & (np.isin(edges.ray, ray[rivals[both]]) | (width > _WIDEST))))
