"""Gate matches between rays and landmarks, assign at most one ray of a frame to each landmark, and refine landmarks."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from objslam.association.landmarks import Landmarks, State
from objslam.association.observations import MIN_DEPTH, SIZED_BY, Observations, UsualSizes
from objslam.association.refinement import range_costs, refine, variance
from objslam.core.arrays import Bools, Floats, Ints
from objslam.core.rotation import dots, skew

TRACK_GAIN = 2.0
"""The amount by which a match costs less if most other boxes of the ray's track have the same landmark. A larger value
trusts the tracker more."""
_ALTERNATIONS = 3  # The most alternations after a change. A larger value converges further.
_FAR = 1e6
"""The distance (m) from the first camera beyond which only parallel rays meet. A larger distance keeps farther landmarks."""
_SETTLED = 1e-9
"""Changes of a position (m) and of a noise factor up to this value count as no change in a refinement. With a larger value,
the refinement ends before positions have settled. The positions of settled landmarks move by 1e-15 m."""
_PAIRS_AT_ONCE = 1 << 15  # The most pairs of a ray and a landmark gated together. A larger value needs more memory.
_FEW_PAIRS = 1 << 12  # Up to this number of pairs, computing all exact costs is faster than computing a bound first.
_TABLE = 1 << 12
"""The most entries of a dense table of gains. Up to about this size, as in the frames of a live session, a dense table is
faster than a sparse one. A larger table of many parts is mostly empty, and its time grows with the cube of its rows."""
_TOGETHER = 1 << 10
"""The approximate number of edges that one call of the Hungarian method gets. A call gets several parts of frames, and has a
fixed cost. With a larger number, there are fewer calls, but each call takes longer, because the method visits all rays for
each ray."""


@dataclass(frozen=True)
class Edges:
    """Possible matches (E,), sorted by ray, then by landmark. deviation: squared deviation of the bearing, in variances (2
    degrees of freedom). vague: 2 ln of a ratio of two areas in the image. The areas are the one where the landmark may
    appear, and the one of the ray's own noise. cost: deviation + vague + the cost of the range."""

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
    # The axis of x, y and z comes first, because NumPy is slow if the last axis is short.
    direction = np.ascontiguousarray(obs.direction.take(ray, axis=0).T)
    to = np.ascontiguousarray((landmarks.position.take(index, axis=0) - obs.origin.take(ray, axis=0)).T)
    distance = np.sqrt(dots(to, to))
    own = variance(obs, distance, landmarks.noise.take(index), ray)
    if pose is None and not landmarks.covariance.any():  # Only the ray has noise, the same along both axes across it.
        offset = to - dots(to, direction) * direction
        deviation, vague, along = dots(offset, offset) / own, np.zeros(len(ray)), np.zeros(len(ray))
    else:
        covariance = _relative_covariance(to.T, landmarks.covariance[index], None if pose is None else pose[ray])
        deviation, vague, along = _deviations(direction.T, to, own, covariance)
    keep = np.flatnonzero(deviation <= gate)
    keep = keep[np.argsort(ray[keep] * len(landmarks.noise) + index[keep])]
    ray, deviation, vague = ray[keep], deviation[keep], vague[keep]
    cost = deviation + vague + range_costs(obs, distance[keep], along[keep], ray)
    return Edges(ray, index[keep], deviation, vague, cost)


def _relative_covariance(to: Floats, landmark: Floats, pose: Floats | None) -> Floats:
    """Return the covariance (E, 3, 3) m^2 of landmarks as seen from uncertain poses. to: (E, 3) m from the camera to the
    landmark. landmark: (E, 3, 3) m^2. pose: (E, 6, 6) as in `gated_edges`."""
    if pose is None:
        return landmark
    lever = skew(to)
    jacobian = np.concatenate([lever, np.broadcast_to(-np.eye(3), lever.shape)], axis=2)
    return landmark + jacobian @ pose @ np.swapaxes(jacobian, 1, 2)


def _deviations(direction: Floats, to: Floats, own: Floats, covariance: Floats) -> tuple[Floats, Floats, Floats]:
    """Return the deviation (E,) and the vagueness (E,) of `Edges`, and the variance (E,) m^2 of the landmark along the ray.

    direction: (E, 3) unit, of the ray. to: (3, E) m, from the camera to the landmark. own: (E,) m^2, the variance of the ray
    alone. covariance: (E, 3, 3) m^2 of the landmark.
    """
    axes = tangent_basis(direction)
    x, y = np.einsum("eij,je->ie", axes, to)
    spread = axes @ covariance @ np.swapaxes(axes, 1, 2)
    a, b, c = spread[:, 0, 0] + own, spread[:, 0, 1], spread[:, 1, 1] + own
    determinant = a * c - b * b
    deviation = (c * x * x - 2 * b * x * y + a * y * y) / determinant
    along = np.einsum("ei,eij,ej->e", direction, covariance, direction)
    return deviation, np.log(determinant / own**2), along


def _near(obs: Observations, landmarks: Landmarks, gate: float, pose: Floats | None) -> tuple[Ints, Ints]:
    """Return the rays and the landmarks of pairs that may be within the gate. The landmark of each pair is in front of the
    camera. If there are more than `_FEW_PAIRS` pairs, a fast bound on the deviation excludes most of them."""
    pairs = len(obs.label) * len(landmarks.noise)
    if pairs <= _FEW_PAIRS:
        ray, index = np.nonzero(landmarks.accepts[:, obs.label].T)
        ahead = np.einsum("ei,ei->e", landmarks.position[index] - obs.origin[ray], obs.direction[ray]) > MIN_DEPTH
        return ray[ahead], index[ahead]
    lines, spread = obs.by_label, np.linalg.eigvalsh(landmarks.covariance)[:, -1]
    if pose is not None:  # Twice the diagonal blocks of `pose` bound its covariance, whatever the correlation.
        turn, move = (2 * gate * np.linalg.eigvalsh(pose[lines.order, i : i + 3, i : i + 3])[:, -1] for i in (0, 3))
    rays, found = list[Ints](), list[Ints]()
    for label in np.flatnonzero(np.diff(lines.bounds)).tolist():
        which = np.flatnonzero(landmarks.accepts[:, label])
        p, noise2 = landmarks.position[which] - lines.centre, gate * landmarks.noise[which, None] ** 2
        p4, p5 = np.column_stack([p, np.ones(len(p))]), np.column_stack([p, (p * p).sum(axis=1), np.ones(len(p))])
        # The constant covers rounding errors.
        fixed = obs.position_sigma**2 * noise2 + gate * (spread[which, None] + 1e-9)
        step = max(1, _PAIRS_AT_ONCE // max(len(which), 1))
        for begin in range(lines.bounds[label], lines.bounds[label + 1], step):
            r = slice(begin, min(begin + step, lines.bounds[label + 1]))
            depth, distance2 = p4 @ lines.depth[:, r], p5 @ lines.distance2[:, r]
            limit = noise2 * lines.sigma2[r]
            if pose is not None:
                limit += turn[r]
            limit *= distance2
            limit += fixed if pose is None else fixed + move[r]
            ahead = depth > MIN_DEPTH
            depth *= depth
            limit += depth
            ahead &= distance2 <= limit
            at = np.flatnonzero(ahead)
            b, a = np.divmod(at, r.stop - r.start)
            rays.append(lines.order[r].take(a))
            found.append(which.take(b))
    return np.concatenate(rays), np.concatenate(found)


def best_assignment(edges: Edges, cost: Floats, frame: Ints, unmatched: float) -> Ints:
    """Return the landmark (R,) of each ray, or -1, in the assignment with the least total cost.

    A landmark gets at most one ray per frame. A frame falls into parts that share no ray and no landmark, and each part is
    solved alone. In most parts, each ray (or each landmark) simply takes its best edge. The Hungarian method solves the
    rest, many parts at a time. cost: (E,) of each edge. frame: (R,) of each ray. unmatched: the cost of a ray without a
    landmark.
    """
    chosen = np.full(len(frame), -1, dtype=np.int64)
    useful = np.flatnonzero(cost < unmatched)
    if len(useful) == 0:
        return chosen
    ray, landmark, gain = edges.ray[useful], edges.landmark[useful], unmatched - cost[useful]
    # A place is one landmark in one frame.
    count = int(landmark.max()) + 1
    places, place = np.unique(frame[ray] * count + landmark, return_inverse=True)
    if len(places) == len(ray) == len(np.unique(ray)):  # Nothing competes, as in many small logs.
        chosen[ray] = landmark
        return chosen
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    size = len(frame) + len(places)
    graph = coo_array((np.ones(len(ray)), (ray, len(frame) + place)), shape=(size, size))
    part = np.asarray(connected_components(graph, directed=False)[1], dtype=np.int64)[ray]
    rest = np.arange(len(ray))
    for one, other in ((ray, place), (place, ray)):
        best, apart = _best_of_each(one[rest], other[rest], gain[rest], part[rest])
        taken = rest[best[apart[best]]]
        chosen[ray[taken]] = landmark[taken]
        rest = rest[~apart]
    rest = rest[np.lexsort((place[rest], ray[rest], part[rest]))]
    begins = np.flatnonzero(np.diff(part[rest], prepend=-1))
    for at in np.split(rest, begins[np.flatnonzero(np.diff(begins // _TOGETHER, prepend=0))]):
        rows, r = np.unique(ray[at], return_inverse=True)
        columns, c = np.unique(place[at], return_inverse=True)
        row, column = pair_up(r, c, gain[at], (len(rows), len(columns)))
        chosen[rows[row]] = places[columns[column]] % count
    return chosen


def _best_of_each(one: Ints, other: Ints, gain: Floats, part: Ints) -> tuple[Ints, Bools]:
    """Return the best edge of each value of `one`, and (E,) whether each edge is in a part without conflicts.

    one, other: (E,) the ray and the landmark in the frame of each edge, or the reverse. In a part without conflicts, no two
    best edges share a value of `other`. Then they are the best assignment of the part. If gains are equal, the first edge
    wins. Its landmark has the lowest index.
    """
    order = np.argsort(one * len(one) + np.arange(len(one)))
    first = np.flatnonzero(np.diff(one[order], prepend=-1))
    top = np.maximum.reduceat(gain[order], first) if len(first) else gain
    length = np.diff(first, append=len(one))
    equal = order[np.flatnonzero(gain[order] == np.repeat(top, length))]
    best = equal[np.flatnonzero(np.diff(one[equal], prepend=-1))]
    conflict = np.zeros(int(part.max(initial=0)) + 1, dtype=bool)
    conflict[part[best[np.bincount(other[best])[other[best]] > 1]]] = True
    return best, ~conflict[part]


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

    An edge pairs a ray with a landmark. Of the other boxes of the ray's track, only those that already have a landmark
    count. They support the edge if at least two of them, and more than half of them, have its landmark. track, matched: (R,)
    the track and the previous landmark of each ray, -1 for none.
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
        same = np.array_equal(matched, before) and np.allclose(position, old.position, rtol=0.0, atol=_SETTLED)
        if same and np.allclose(state.noise, old.noise, rtol=0.0, atol=_SETTLED):
            # The state stays, with its cached properties. A new state would compute the history of its landmarks again.
            stays = plausible(state)
            return state if stays.all() else state.keep(stays)
        state = replace(state, landmarks=replace(old, position=position), matched=matched)
        stays = plausible(state)
        state = replace(state, landmarks=replace(state.landmarks, noise=state.noise)).keep(stays)
        if np.array_equal(matched, before):
            break
    return state


def explained(state: State, gate: float) -> Floats:
    """Return the amount (L,) by which the landmarks of each label lower the cost of its rays."""
    edges = gated_edges(state.obs, state.landmarks, gate)
    own = state.matched[edges.ray] == edges.landmark
    gain = gate - edges.cost + _appearance_gain(state, edges)
    return np.asarray(np.bincount(state.obs.label[edges.ray[own]], gain[own], state.landmarks.accepts.shape[1]), dtype=float)


def near(state: State) -> Bools:
    """Return which landmarks (N,) are near enough. Farther away, only parallel rays meet."""
    return np.asarray((np.abs(state.landmarks.position - state.obs.origin[:1]) < _FAR).all(axis=1))
