"""The boxes of one frame to landmarks and candidates: predicted bearing, its covariance, a gate, and the best assignment."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from objslam.association.assign import gate_limit
from objslam.association.landmarks import RANGE_LOSS, Landmarks
from objslam.association.matches import Edges, gated_edges
from objslam.association.sightings import Sightings
from objslam.live.expected import Expected
from objslam.live.known import HORIZON, covariances, gathered, levers, long_unseen, noise
from objslam.live.meeting import sightings
from objslam.live.returning import expected_unknown, trusted
from objslam.live.table import Table
from objslam.types import Bools, Floats, Ints

_VIEW = np.cos(np.radians(40.0))  # landmarks further off every box of a frame are not looked at
_BEYOND, _NEAR = (
    1.5,
    10.0,
)  # times the greatest distance from which anything was seen, and m; what is further is not looked at
_ROUGH = 3.0  # times the noise of a ray: a bearing that is predicted less well is rough,
_VAGUE = 2 * np.log(_ROUGH)  # as `Edges.vague` has it
_CLEAR = 6.0  # squared deviations by which the best of several places that are all rough must be better
_WIDEST = 0.3  # m; a place that is rougher than that tells no landmark from another
_PLACED = 0.1  # m; a camera known that well in the map tells apart what it saw long ago, too
_BY_LABEL = 4.0  # times the gate, where only one object has the label


@dataclass(frozen=True)
class FrameRays:
    """The usable boxes of one frame: direction (n, 3) in the camera, sigma (n,) rad, range and range_sigma (n,) m, label and
    score (n,), box (n, 4) px, track (n,)."""

    direction: Floats
    sigma: Floats
    range: Floats
    range_sigma: Floats
    label: Ints
    score: Floats
    box: Floats
    track: Ints

    def __len__(self) -> int:
        return len(self.direction)

    def take(self, rays: Ints) -> FrameRays:
        """Some of them (m,)."""
        return FrameRays(**{name: value[rays] for name, value in vars(self).items()})


@dataclass(frozen=True)
class Doubt:
    """How little the camera's pose is known: drift (6, 6) gathered by now, which camera_from_drift (6, 6) takes to the
    camera's frame; pose (6, 6), the covariance of the pose itself, in that frame."""

    drift: Floats
    camera_from_drift: Floats
    pose: Floats

    @property
    def placed(self) -> bool:
        """Whether the camera's place in the map is known well."""
        variance = self.pose.diagonal().tolist()
        return sum(variance[:3]) < HORIZON**2 and sum(variance[3:]) < _PLACED**2


def match(
    rays: FrameRays,
    map_T_camera: Floats,
    expected: Expected,
    doubt: Doubt,
    labels: int,
    gate: float,
    tracks: dict[int, int],
    novelty: float = 1.0,
) -> Ints:
    """For each ray (n,) which of the expected it is of, or -1.

    Candidates that were not seen for long are none of them, unless the camera's place is known well. tracks: the landmark
    (id) that a detector's track was given last. novelty: the share of boxes that showed nothing known, of late.
    """
    s, origin = in_map(rays, map_T_camera), map_T_camera[:3, 3]
    rows = _possible(s, origin, expected, doubt, labels)
    if not len(rows):
        return np.full(len(rays), -1, dtype=np.int64)
    landmark, label, own, then = (
        rows < expected.landmarks,
        expected.label[rows],
        expected.covariance[rows],
        expected.drift[rows],
    )
    places, noises = expected.position[rows], expected.noise[rows]
    to = places - origin
    accepts = label[:, None] == np.arange(labels)
    limit = gate_limit(gate)
    edges = gated_edges(s, Landmarks(places, own + _doubtful(to, then, map_T_camera, doubt), noises, accepts), limit)
    edges = _clear(edges, rays.sigma, to, landmark)
    cost = edges.cost
    if tracks and (rays.track >= 0).any():
        before = np.array([tracks.get(t, -1) for t in rays.track.tolist()])
        cost = cost - np.where(before[edges.ray] == expected.id[rows][edges.landmark], 2.0, 0.0)
    unmatched = limit + RANGE_LOSS + float(edges.vague.max(initial=0.0)) + 1e-9
    chosen = _best(edges, cost, len(rays), len(places), unmatched)
    unseen = long_unseen(doubt.drift, then) & landmark
    back = np.flatnonzero((chosen >= 0) & unseen[chosen])
    if len(back):
        at, some = chosen[back], s.take(back)
        landmarks = Landmarks(places[at], own[at], noises[at], accepts[at])
        worst = _least(then[at], to[at], doubt)
        sure = back[trusted(some, landmarks, worst, map_T_camera, expected_unknown(some, rows[at], expected, novelty))]
        if len(sure) < len(back):  # what is best of all stays so without what was not chosen
            keep = ~unseen[edges.landmark] | (np.isin(edges.ray, sure) & (chosen[edges.ray] == edges.landmark))
            chosen = _best(_some(edges, keep), cost[keep], len(rays), len(places), unmatched)
    return np.where(chosen >= 0, rows[chosen], -1)


def match_by_label(rays: FrameRays, map_T_camera: Floats, known: Table, doubt: Doubt, gate: float) -> tuple[Ints, Ints]:
    """The same where every label is one object: the row (n,) of each ray's landmark or -1, and that of the one it misses.

    Of several boxes with one label the one with the highest score counts.
    """
    rows = np.flatnonzero(np.isin(known.label, rays.label))
    hit, missed = (np.full(len(rays), -1, dtype=np.int64) for _ in range(2))
    if not len(rows):
        return hit, missed
    s = in_map(rays, map_T_camera)
    position = known.position[rows]
    doubtful = _doubtful(position - map_T_camera[:3, 3], known.drift[rows], map_T_camera, doubt)
    accepts = known.label[rows][:, None] == np.arange(int(max(rays.label.max(), known.label.max())) + 1)
    landmarks = Landmarks(position, covariances(known, rows) + doubtful, noise(known, rows), accepts)
    edges = gated_edges(s, landmarks, _BY_LABEL * gate_limit(gate))
    hit[edges.ray] = rows[edges.landmark]
    for i in np.flatnonzero(hit < 0).tolist():
        same = rows[known.label[rows] == rays.label[i]]
        missed[i] = same[0] if len(same) else -1
    return hit, missed


def best_of_label(rays: FrameRays) -> Ints:
    """Indices of the rays (m,) that have the highest score of their label."""
    order = np.lexsort((np.arange(len(rays)), -rays.score, rays.label))
    _, first = np.unique(rays.label[order], return_index=True)
    return np.sort(order[first])


def in_map(rays: FrameRays, map_T_camera: Floats) -> Sightings:
    """The rays as lines in map."""
    direction = rays.direction @ map_T_camera[:3, :3].T
    origin = np.broadcast_to(map_T_camera[:3, 3], direction.shape)
    return sightings(origin, direction, rays.sigma, rays.range, rays.range_sigma, rays.label)


def _possible(s: Sightings, origin: Floats, expected: Expected, doubt: Doubt, labels: int) -> Ints:
    """Which of the expected (n,) the rays from one origin (3,) could show."""
    shown = np.zeros(labels + 1, dtype=bool)  # the last one is that of label -1
    shown[s.label] = True
    wanted = np.flatnonzero(shown[expected.label])
    to = expected.position[wanted] - origin
    distance = np.sqrt((to * to).sum(axis=1))
    ahead = (to @ s.direction.T).max(axis=1, initial=-np.inf) > _VIEW * distance
    ahead &= distance < max(_BEYOND * expected.far, _NEAR)
    if doubt.placed:
        return wanted[ahead | (wanted >= expected.landmarks)]
    lately = expected.drift[wanted, 2, 2] > doubt.drift[2, 2] - HORIZON**2
    return wanted[np.where(wanted < expected.landmarks, ahead, lately)]


def _doubtful(to: Floats, then: Floats, map_T_camera: Floats, doubt: Doubt) -> Floats:
    """Covariances (n, 3, 3) of how places `to` (n, 3) away lie to the camera, by the doubt about where the camera is.

    What the odometry gathered since the drift was `then` (n, 6, 6), or the doubt about its place in the map, whichever is
    less; where the graph does not tell that, its NaN is not.
    """
    lever = levers(to, map_T_camera)
    back = np.swapaxes(lever, 1, 2)
    since = lever @ (doubt.camera_from_drift @ gathered(doubt.drift, then) @ doubt.camera_from_drift.T) @ back
    placed = lever @ doubt.pose @ back
    less = np.trace(placed, axis1=1, axis2=2) < np.trace(since, axis1=1, axis2=2)
    return np.where(less[:, None, None], placed, since)


def _least(then: Floats, to: Floats, doubt: Doubt) -> Floats:
    """The covariance (6, 6) of the camera's pose against places `to` (n, 3) away, last seen at the drifts `then` (n, 6, 6).

    One for all of them, by that which was not seen for longest.
    """
    oldest = then[np.trace(then, axis1=1, axis2=2).argmin()]
    since = doubt.camera_from_drift @ gathered(doubt.drift, oldest[None])[0] @ doubt.camera_from_drift.T
    if not np.isfinite(doubt.pose).all():
        return since
    reach = float(np.mean(to**2)) * 3
    size = [np.trace(c[:3, :3]) * reach + np.trace(c[3:, 3:]) for c in (since, doubt.pose)]
    return since if size[0] <= size[1] else doubt.pose


def _best(edges: Edges, cost: Floats, rays: int, places: int, unmatched: float) -> Ints:
    """The place of each ray (n,) of one frame, -1 none, with the least total cost: what `matches.choose` is for a log."""
    from scipy.optimize import linear_sum_assignment

    gain = np.zeros((rays, places))
    gain[edges.ray, edges.landmark] = np.maximum(unmatched - cost, 0.0)
    chosen = np.full(rays, -1, dtype=np.int64)
    ray, place = linear_sum_assignment(gain, maximize=True)
    real = gain[ray, place] > 0
    chosen[ray[real]] = place[real]
    return chosen


def _some(edges: Edges, keep: Bools) -> Edges:
    return Edges(edges.ray[keep], edges.landmark[keep], edges.deviation[keep], edges.vague[keep], edges.cost[keep])


def _clear(edges: Edges, sigma: Floats, to: Floats, landmark: Bools) -> Edges:
    """Without the matches to landmarks that are expected only roughly, where it could as well be another.

    Where no place at all is expected, a single box tells nothing: several landmarks must tell together (`loops`). to: (N, 3)
    m, the way to each place; landmark: (N,) whether it is one.
    """
    rough = (edges.vague > _VAGUE) & landmark[edges.landmark]
    if not rough.any():
        return edges
    away = np.linalg.norm(to[edges.landmark], axis=1)
    width = sigma[edges.ray] * away * np.exp(edges.vague / 4)  # the side of a square as large as what the landmark covers
    order = np.lexsort((edges.cost, edges.ray))
    ray, cost = edges.ray[order], edges.cost[order]
    rivals = np.flatnonzero((np.diff(ray) == 0) & (np.diff(cost) < _CLEAR) & (np.diff(ray, prepend=-1)[:-1] != 0)) + 1
    both = rough[order[rivals]] & rough[order[rivals - 1]]
    return _some(edges, ~(rough & (np.isin(edges.ray, ray[rivals[both]]) | (width > _WIDEST))))
