"""Gate matches between rays and landmarks, assign at most one ray of a frame to each landmark, and refine landmarks."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from objslam.association.landmarks import Landmarks, State
from objslam.association.observations import MIN_DEPTH, SIZED_BY, Observations, UsualSizes
from objslam.association.refinement import range_costs, refine, variance
from objslam.core.arrays import Bools, Floats, Ints
from objslam.core.rotation import skew

TRACK_GAIN = 2.0
"""The amount by which a match costs less if most other boxes of the ray's track have the same landmark. A larger value
trusts the tracker more."""
_ALTERNATIONS = 3  # The most alternations after a change. A larger value converges further.
_FAR = 1e6
"""The distance (m) from the first camera beyond which only parallel rays meet. A larger distance keeps farther landmarks."""
_PAIRS_AT_ONCE = 1 << 19  # The most pairs of a ray and a landmark gated together. A larger value needs more memory.
_FEW_PAIRS = 1 << 12  # Up to this number of pairs, computing all exact costs is faster than computing a bound first.
_TABLE = 1 << 22  # The most entries of a dense table of gains. Larger tables are sparse.


@dataclass(frozen=True)
class Edges:
    """Possible matches (E,), sorted by ray, then by landmark. deviation: squared deviation of the bearing, in variances (2
    degrees of freedom). vague: 2 ln of the ratio of two areas in the image: the area where the landmark may appear, and the
    area of the ray's own noise. cost: deviation + vague + the cost of the range."""

    ray: Ints
    landmark: Ints
    deviation: Floats
    vague: Floats
    cost: Floats


def tangent_basis(direction: Floats) -> Floats:
    """Return two unit vectors (R, 2, 3) perpendicular to each other and to each unit direction (R, 3)."""
    turn = skew(direction)
    furthest = np.abs(direction).argmin(axis=1)  # The map axis that is least parallel to the direction.
    axes = np.empty((len(direction), 2, 3))
    first = turn[np.arange(len(direction)), :, furthest]
    axes[:, 0] = first / np.sqrt((first * first).sum(axis=1))[:, None]
    axes[:, 1] = (turn @ axes[:, 0, :, None])[:, :, 0]
    return axes


def gated_edges(obs: Observations, landmarks: Landmarks, gate: float, pose: Floats | None = None) -> Edges:
    """Return the possible matches of a ray and a landmark.

    The landmark must be in front of the camera and accept the label of the ray. The squared deviation of the bearing must be
    at most `gate`. pose: (R, 6, 6) covariance of the camera pose of each ray. Its first three rows are rotations about the
    map axes (rad), its last three the position (m).
    """
    ray, index = _near(obs, landmarks, gate, pose)
    direction = obs.direction[ray]
    to = landmarks.position[index] - obs.origin[ray]
    distance = np.sqrt(np.einsum("ei,ei->e", to, to))
    axes = tangent_basis(direction)
    x, y = np.einsum("eij,ej->ie", axes, to)
    covariance = landmarks.covariance[index]
    if pose is not None:
        lever = skew(to)
        jacobian = np.concatenate([lever, np.broadcast_to(-np.eye(3), lever.shape)], axis=2)
        covariance = covariance + jacobian @ pose[ray] @ np.swapaxes(jacobian, 1, 2)
    spread = axes @ covariance @ np.swapaxes(axes, 1, 2)
    own = variance(obs, distance, landmarks.noise[index], ray)
    a, b, c = spread[:, 0, 0] + own, spread[:, 0, 1], spread[:, 1, 1] + own
    determinant = a * c - b * b
    deviation = (c * x * x - 2 * b * x * y + a * y * y) / determinant
    along = np.einsum("ei,eij,ej->e", direction, covariance, direction)
    vague = np.log(determinant / own**2)
    cost = deviation + vague + range_costs(obs, distance, along, ray)
    keep = np.flatnonzero(deviation <= gate)
    keep = keep[np.lexsort((index[keep], ray[keep]))]
    return Edges(ray[keep], index[keep], deviation[keep], vague[keep], cost[keep])


def _near(obs: Observations, landmarks: Landmarks, gate: float, pose: Floats | None) -> tuple[Ints, Ints]:
    """Return the rays and the landmarks of pairs that may be within the gate. The landmark of each pair is in front of the
    camera. If there are more than `_FEW_PAIRS` pairs, a fast bound on the deviation excludes most of them."""
    pairs = len(obs.label) * len(landmarks.noise)
    if pairs <= _FEW_PAIRS:
        ray, index = np.nonzero(landmarks.accepts[:, obs.label].T)
        ahead = np.einsum("ei,ei->e", landmarks.position[index] - obs.origin[ray], obs.direction[ray]) > MIN_DEPTH
        return ray[ahead], index[ahead]
    spread = np.linalg.eigvalsh(landmarks.covariance)[:, -1]
    turn, move = np.zeros((2, len(obs.label)))
    if pose is not None:  # Twice its diagonal blocks are an upper bound of the covariance for any correlation.
        turn, move = (np.asarray(2 * np.linalg.eigvalsh(pose[:, i : i + 3, i : i + 3])[:, -1]) for i in (0, 3))
    rays, found = list[Ints](), list[Ints]()
    centre = obs.origin.mean(axis=0)
    for label in np.unique(obs.label):
        mine, which = np.flatnonzero(obs.label == label), np.flatnonzero(landmarks.accepts[:, label])
        p, noise2 = landmarks.position[which] - centre, landmarks.noise[which] ** 2
        p2 = (p * p).sum(axis=1)
        step = max(1, _PAIRS_AT_ONCE // max(len(which), 1))
        for begin in range(0, len(mine), step):
            r = mine[begin : begin + step]
            m, n = obs.origin[r] - centre, obs.direction[r]
            depth = n @ p.T - (m * n).sum(axis=1)[:, None]
            distance2 = (m * m).sum(axis=1)[:, None] + p2 - 2 * m @ p.T
            limit = distance2 * ((obs.sigma[r] ** 2)[:, None] * noise2 + turn[r, None]) + obs.position_sigma**2 * noise2
            limit += spread[which] + move[r, None] + 1e-9  # The constant covers rounding errors.
            a, b = np.nonzero((distance2 - depth * depth <= gate * limit) & (depth > MIN_DEPTH))
            rays.append(r[a])
            found.append(which[b])
    return np.concatenate(rays), np.concatenate(found)


def best_assignment(edges: Edges, cost: Floats, frame: Ints, unmatched: float) -> Ints:
    """Return the landmark (R,) of each ray, or -1, in the assignment with the least total cost.

    A landmark gets at most one ray per frame. A frame falls into parts that share no ray and no landmark, and each part is
    solved alone. In most parts, each ray (or each landmark) simply takes its best edge. The Hungarian method solves the
    rest. cost: (E,) of each edge. frame: (R,) of each ray. unmatched: the cost of a ray without a landmark.
    """
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    chosen = np.full(len(frame), -1, dtype=np.int64)
    useful = np.flatnonzero(cost < unmatched)
    if len(useful) == 0:
        return chosen
    ray, landmark, gain = edges.ray[useful], edges.landmark[useful], unmatched - cost[useful]
    # A place is one landmark in one frame.
    places, place = np.unique(frame[ray] * (int(landmark.max()) + 1) + landmark, return_inverse=True)
    size = len(frame) + len(places)
    graph = coo_array((np.ones(len(ray)), (ray, len(frame) + place)), shape=(size, size))
    part = np.asarray(connected_components(graph, directed=False)[1], dtype=np.int64)[ray]
    rest = np.arange(len(ray))
    for one, other in ((ray, place), (place, ray)):
        best, apart = _best_of_each(one[rest], other[rest], landmark[rest], gain[rest], part[rest])
        taken = rest[best[apart[best]]]
        chosen[ray[taken]] = landmark[taken]
        rest = rest[~apart]
    order = np.lexsort((landmark[rest], ray[rest], part[rest]))
    rest = rest[order]
    ray, landmark, gain, part = ray[rest], landmark[rest], gain[rest], part[rest]
    bounds = np.flatnonzero(np.diff(part, prepend=-1, append=-1)).tolist()
    for i, j in pairwise(bounds):
        rows, r = np.unique(ray[i:j], return_inverse=True)
        columns, c = np.unique(landmark[i:j], return_inverse=True)
        row, column = pair_up(r, c, gain[i:j], (len(rows), len(columns)))
        chosen[rows[row]] = columns[column]
    return chosen


def _best_of_each(one: Ints, other: Ints, landmark: Ints, gain: Floats, part: Ints) -> tuple[Ints, Bools]:
    """Return the best edge of each value of `one`, and (E,) whether each edge is in a part without conflicts.

    one, other: (E,) the ray and the landmark in the frame of each edge, or the reverse. In a part without conflicts, no two
    best edges share a value of `other`. Then they are the best assignment of the part. Of equal gains, the landmark with the
    lowest index wins.
    """
    order = np.lexsort((landmark, -gain, one))
    best = order[np.flatnonzero(np.diff(one[order], prepend=-1))]
    by_other = best[np.argsort(other[best], kind="stable")]
    twice = np.flatnonzero(np.diff(other[by_other]) == 0)
    return best, ~np.isin(part, part[by_other[twice]])


def pair_up(row: Ints, column: Ints, gain: Floats, shape: tuple[int, int]) -> tuple[Ints, Ints]:
    """Return the pairs (P,) of a row and a column with the greatest total gain (Hungarian method).

    Each row and each column is in at most one pair. row, column, gain: (E,) of the possible pairs, with gains above 0.
    shape: the numbers of rows and columns.
    """
    from scipy.optimize import linear_sum_assignment
    from scipy.sparse import csr_array
    from scipy.sparse.csgraph import min_weight_full_bipartite_matching

    rows, columns = shape
    if rows * columns <= _TABLE:
        dense = np.zeros(shape)
        dense[row, column] = gain
        first, second = linear_sum_assignment(dense, maximize=True)
        real = dense[first, second] > 0
        return first[real], second[real]
    # The sparse method pairs every row. So each row gets an extra column of its own, which means no pair.
    each = np.arange(rows)
    value = np.concatenate([gain, np.zeros(rows)]) + 1.0  # The sparse method ignores entries of 0.
    entries = (np.append(row, each), np.append(column, columns + each))
    table = csr_array((value, entries), (rows, columns + rows))
    one, other = (np.asarray(found, dtype=np.int64) for found in min_weight_full_bipartite_matching(table, maximize=True))
    return one[other < columns], other[other < columns]


def track_bonus(edges: Edges, track: Ints, matched: Ints) -> Floats:
    """Return the cost reduction (E,) of each edge: `TRACK_GAIN` if the other boxes of the ray's track support it, else 0.

    The track supports an edge if at least two of its other boxes have the landmark of the edge, and if most of its other
    boxes with a landmark have this landmark. track, matched: (R,) the track and the previous landmark of each ray, -1 for
    none.
    """
    bonus = np.zeros(len(edges.ray))
    known = np.flatnonzero((track >= 0) & (matched >= 0))
    if len(known) == 0:
        return bonus
    base = int(matched.max()) + 1
    keys, counts = np.unique(track[known] * base + matched[known], return_counts=True)
    tracks, total = np.unique(track[known], return_counts=True)
    which = np.flatnonzero((track[edges.ray] >= 0) & (edges.landmark < base))
    ray, landmark = edges.ray[which], edges.landmark[which]
    at = np.minimum(np.searchsorted(keys, track[ray] * base + landmark), len(keys) - 1)
    same = keys[at] == track[ray] * base + landmark
    t = np.minimum(np.searchsorted(tracks, track[ray]), len(tracks) - 1)
    others = np.where(same, counts[at], 0) - (matched[ray] == landmark)
    of = np.where(tracks[t] == track[ray], total[t], 0) - (matched[ray] >= 0)
    bonus[which] = np.where((others >= 2) & (2 * others > of), TRACK_GAIN, 0.0)
    return bonus


def size_costs(state: State, edges: Edges) -> Floats:
    """Return the cost (E,) of the size of the box in each match (`UsualSizes.costs`)."""
    if not (state.ray_count >= SIZED_BY).any():
        return np.zeros(len(edges.ray))
    usual = UsualSizes.of(state.obs.size[state.assigned], state.distance, state.owner, state.count)
    away = np.linalg.norm(state.landmarks.position[edges.landmark] - state.obs.origin[edges.ray], axis=1)
    return usual.costs(state.obs, edges.ray, edges.landmark, away)


def _appearance_gain(state: State, edges: Edges) -> Floats | float:
    """Return the amount (E,) by which each edge costs less because the ray looks like its landmark. 0 without vectors."""
    if state.looks is None:
        return 0.0
    own = state.matched[edges.ray] == edges.landmark
    return 2 * state.looks.ray_odds(state.obs, edges.ray, edges.landmark, own)


def gate_limit(share: float) -> float:
    """Return the squared deviation (chi-squared, 2 degrees of freedom) below which a `share` of correct matches lies."""
    return float(-2 * np.log1p(-share))


def alternate(
    state: State,
    gate: float,
    plausible: Callable[[State], Bools],
    times: int = _ALTERNATIONS,
    unmatched: Callable[[State, Edges], Floats] | None = None,
) -> State:
    """Alternate between assignment and refinement until no ray changes its landmark, at most `times` times.

    plausible: returns which landmarks (N,) stay. unmatched: returns for each match the cost (E,) of its ray if the ray had
    no landmark. If not given, this cost is the gate.
    """
    for _ in range(times):
        obs, old, before = state.obs, state.landmarks, state.matched
        edges = gated_edges(obs, old, gate)
        most = gate
        cost = edges.cost - track_bonus(edges, obs.track, before) - _appearance_gain(state, edges)
        if unmatched is not None:
            cost, most = cost - unmatched(state, edges), 0.0
        matched = best_assignment(edges, cost, obs.frame, most)
        held = np.flatnonzero(matched >= 0)
        position = refine(obs, held, matched[held], old.position, old.noise)
        state = replace(state, landmarks=replace(old, position=position), matched=matched)
        stays = plausible(state)
        state = replace(state, landmarks=replace(state.landmarks, noise=state.noise)).keep(stays)
        if np.array_equal(matched, before):
            break
    return state


def explained(state: State, gate: float) -> Floats:
    """Return for each label (L,) by how much its landmarks lower the cost of its rays."""
    edges = gated_edges(state.obs, state.landmarks, gate)
    own = state.matched[edges.ray] == edges.landmark
    gain = gate - edges.cost + _appearance_gain(state, edges)
    return np.asarray(np.bincount(state.obs.label[edges.ray[own]], gain[own], state.landmarks.accepts.shape[1]), dtype=float)


def near(state: State) -> Bools:
    """Return which landmarks (N,) are near enough. Farther away, only parallel rays meet."""
    return np.asarray((np.abs(state.landmarks.position - state.obs.origin[:1]) < _FAR).all(axis=1))
