"""The association of one frame's boxes with landmarks and tracks, by gating and the best assignment."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from objslam.association.gating import TRACK_GAIN, Edges, gate_limit, gated_edges, pair_up
from objslam.association.joint_compatibility import jointly_compatible, unknown_density
from objslam.association.landmarks import Landmarks, PredictedLandmarks
from objslam.association.observations import SIZED_BY, Observations, UsualSizes
from objslam.association.refinement import RANGE_LOSS
from objslam.core.arrays import Bools, Floats, Ints
from objslam.live.mapper.pose_uncertainty import PoseUncertainty, long_unseen

_VIEW = np.cos(np.radians(40.0))  # The cosine of the largest angle from a box to a candidate. A larger angle costs time.
_BEYOND = 1.5  # Candidates are within this multiple of the largest observed distance. A larger factor costs time.
_NEAR = 10.0  # Landmarks in view and nearer than this (m) are always candidates. A larger distance costs time.
_ROUGH = 3.0
"""A candidate is rough if the image area of its uncertainty exceeds this multiple of the image area of a ray's noise. With a
larger value, fewer candidates are rough."""
_CLEAR = 6.0  # The least cost difference of the two best candidates, if both are rough. A larger value matches fewer rays.
_WIDEST = 0.3  # The uncertainty (m) above which a rough candidate is dropped. A larger value matches more boxes.
_BY_LABEL = 4.0  # The factor on the gate if every label is one object. A larger factor keeps more rays after a drift.


@dataclass(frozen=True)
class FrameRays:
    """The rays of the usable boxes of one frame.

    direction: (n, 3) unit vectors in the camera frame. sigma: (n,) rad. range, range_sigma: (n,) m, NaN if unknown. label:
    (n,) the numbers of the labels. score: (n,). box: (n, 4) px. size: (n, 2) width and height in m per m of distance, 0 if
    the camera sees no sizes. track: (n,) the track ids of the detector, -1 if unknown.
    """

    direction: Floats
    sigma: Floats
    range: Floats
    range_sigma: Floats
    label: Ints
    score: Floats
    box: Floats
    size: Floats
    track: Ints

    def take(self, rays: Ints) -> FrameRays:
        """Return the rays with these indices (m,)."""
        return FrameRays(**{name: value[rays] for name, value in vars(self).items()})

    def turned(self, added: Floats, sigma: Floats) -> FrameRays:
        """Return the rays with `added` (n, 3) added to the directions. sigma: (n,) rad, the noise of `added`."""
        direction = self.direction + added
        direction /= np.linalg.norm(direction, axis=1, keepdims=True)
        return replace(self, direction=direction, sigma=np.hypot(self.sigma, sigma))


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
    """Return the index in `predicted` of the landmark or track of each ray (n,), -1 for a ray without one.

    `long_unseen` tracks are excluded, unless the camera pose in the map is certain. Long unseen landmarks must be compatible
    with each other (`jointly_compatible`). map_T_camera: (4, 4) predicted camera pose, with its `uncertainty`. labels: the
    number of labels. gate: the share of the right matches that pass the gate. landmark_of_track: the id of the last landmark
    of each detector track. novelty: the recent share of boxes that match no landmark.
    """
    obs, origin, count = in_map(rays, map_T_camera), map_T_camera[:3, 3], len(rays.label)
    unseen = long_unseen(uncertainty.drift, predicted.drift)
    rows = _possible(obs, origin, predicted, uncertainty, unseen)
    if not len(rows):
        return np.full(count, -1, dtype=np.int64)
    landmark, own, then = rows < predicted.landmarks, predicted.covariance[rows], predicted.drift[rows]
    places, noises = predicted.position[rows], predicted.noise[rows]
    to = places - origin
    accepts = predicted.label[rows][:, None] == np.arange(labels)
    limit = gate_limit(gate)
    spread = own + uncertainty.of_landmarks(to, then, map_T_camera)
    edges = gated_edges(obs, Landmarks(places, spread, noises, accepts), limit)
    edges = _with_sizes(edges, obs, predicted.sizes.take(rows), to, spread)
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
        if len(sure) < len(back):  # Assign again. Long unseen landmarks may only get the rays that proved compatible.
            keep = ~unseen[edges.landmark] | (np.isin(edges.ray, sure) & (chosen[edges.ray] == edges.landmark))
            chosen = _best(_some(edges, keep), cost[keep], count, len(places), unmatched)
    return np.where(chosen >= 0, rows[chosen], -1)


def match_by_label(
    rays: FrameRays, map_T_camera: Floats, predicted: PredictedLandmarks, uncertainty: PoseUncertainty, gate: float
) -> tuple[Ints, Ints]:
    """Match each ray to the landmark of its label, and return the row (n,) of this landmark in one of two arrays.

    The first array holds the row if the ray is inside the gate, the second array if the ray is outside. All other entries
    are -1. predicted: landmarks only.
    """
    label = predicted.label
    rows = np.flatnonzero(np.isin(label, rays.label))
    hit, missed = (np.full(len(rays.label), -1, dtype=np.int64) for _ in range(2))
    if not len(rows):
        return hit, missed
    position = predicted.position[rows]
    moved = uncertainty.of_landmarks(position - map_T_camera[:3, 3], predicted.drift[rows], map_T_camera)
    accepts = label[rows][:, None] == np.arange(int(max(rays.label.max(), label.max())) + 1)
    places = Landmarks(position, predicted.covariance[rows] + moved, predicted.noise[rows], accepts)
    edges = gated_edges(in_map(rays, map_T_camera), places, _BY_LABEL * gate_limit(gate))
    hit[edges.ray] = rows[edges.landmark]
    for i in np.flatnonzero(hit < 0).tolist():
        missed[i] = next(iter(rows[label[rows] == rays.label[i]]), -1)
    return hit, missed


def best_of_label(rays: FrameRays) -> Ints:
    """Return the indices (m,) of the rays with the highest score of their label."""
    order = np.lexsort((np.arange(len(rays.label)), -rays.score, rays.label))
    _, first = np.unique(rays.label[order], return_index=True)
    return np.sort(order[first])


def in_map(rays: FrameRays, map_T_camera: Floats, which: Ints | slice = slice(None)) -> Observations:
    """Return rays as observations in the frame `map`. map_T_camera: (4, 4). which: the indices of the rays to return."""
    direction = rays.direction[which] @ map_T_camera[:3, :3].T
    origin = np.broadcast_to(map_T_camera[:3, 3], direction.shape)
    lines = Observations.of_lines(
        origin, direction, rays.sigma[which], rays.range[which], rays.range_sigma[which], rays.label[which]
    )
    return replace(lines, size=rays.size[which])


def _possible(
    obs: Observations, origin: Floats, predicted: PredictedLandmarks, uncertainty: PoseUncertainty, unseen: Bools
) -> Ints:
    """Return the indices in `predicted` of the candidates for rays from one origin (3,), m.

    unseen: whether each of the predicted landmarks and tracks is long unseen.
    """
    wanted = np.flatnonzero(np.isin(predicted.label, obs.label))
    to = predicted.position[wanted] - origin
    distance = np.sqrt((to * to).sum(axis=1))
    ahead = (to @ obs.direction.T).max(axis=1, initial=-np.inf) > _VIEW * distance
    ahead &= distance < max(_BEYOND * predicted.far, _NEAR)
    of_track = wanted >= predicted.landmarks
    return wanted[np.where(of_track, uncertainty.is_placed | ~unseen[wanted], ahead)]


def _best(edges: Edges, cost: Floats, rays: int, places: int, unmatched: float) -> Ints:
    """Return the candidate of each ray (n,), or -1, in the assignment with the least total cost.

    cost: (E,) the costs of the edges, which may be negative. rays, places: the numbers of rays and of candidates. unmatched:
    the cost of a ray without a candidate.
    """
    useful = np.flatnonzero(cost < unmatched)
    ray, place = pair_up(edges.ray[useful], edges.landmark[useful], unmatched - cost[useful], (rays, places))
    chosen = np.full(rays, -1, dtype=np.int64)
    chosen[ray] = place
    return chosen


def _some(edges: Edges, keep: Bools) -> Edges:
    return Edges(**{name: value[keep] for name, value in vars(edges).items()})


def _with_sizes(edges: Edges, obs: Observations, usual: UsualSizes, to: Floats, spread: Floats) -> Edges:
    """Add the costs of sizes (`UsualSizes.costs`), where a box may belong to several landmarks with a size.

    Sizes only decide between such landmarks, so the least cost of a box is subtracted from all costs of this box. Otherwise,
    a candidate without a size would win the box of a badly placed landmark, and become a duplicate of this landmark. usual:
    the sizes of the m candidates. to: (m, 3) m, from the camera to the candidates. spread: (m, 3, 3) m^2, the covariance of
    `to`.
    """
    sized = usual.number[edges.landmark] >= SIZED_BY
    several = np.bincount(edges.ray[sized], minlength=len(obs)) > 1
    some = np.flatnonzero(sized & several[edges.ray])
    if not len(some):
        return edges
    ray, landmark = edges.ray[some], edges.landmark[some]
    way = to[landmark]
    away = np.sqrt((way * way).sum(axis=1))
    along = np.sqrt(np.einsum("ei,eij,ej->e", way, spread[landmark], way)) / away
    added = usual.costs(obs, ray, landmark, away, along)
    first = np.flatnonzero(np.diff(ray, prepend=-1))  # The edges are sorted by ray.
    cost = edges.cost.copy()
    cost[some] += added - np.repeat(np.minimum.reduceat(added, first), np.diff(first, append=len(ray)))
    return replace(edges, cost=cost)


def _clear(edges: Edges, sigma: Floats, to: Floats, landmark: Bools) -> Edges:
    """Remove matches with rough landmarks (_ROUGH) if they are ambiguous (_CLEAR) or too uncertain (_WIDEST).

    Loop closure may match these landmarks later. sigma: (n,) rad, the noise of the rays. to: (m, 3) m from the camera to
    each candidate. landmark: (m,) False for a track.
    """
    rough = (edges.vague > 2 * np.log(_ROUGH)) & landmark[edges.landmark]
    if not rough.any():
        return edges
    away = np.linalg.norm(to[edges.landmark], axis=1)
    width = sigma[edges.ray] * away * np.exp(edges.vague / 4)  # The side of a square with the area of the uncertainty.
    order = np.lexsort((edges.cost, edges.ray))
    ray, cost = edges.ray[order], edges.cost[order]
    rivals = np.flatnonzero((np.diff(ray) == 0) & (np.diff(cost) < _CLEAR) & (np.diff(ray, prepend=-1)[:-1] != 0)) + 1
    both = rough[order[rivals]] & rough[order[rivals - 1]]
    return _some(edges, ~(rough & (np.isin(edges.ray, ray[rivals[both]]) | (width > _WIDEST))))
