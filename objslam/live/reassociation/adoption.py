"""Correct a live map by an association of the drive so far: its landmarks, the landmark of each ray, and the path."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass

import numpy as np
from scipy.optimize import linear_sum_assignment

from objslam.core.arrays import Bools, Floats, Ints
from objslam.core.geometry import inverse
from objslam.live.mapper.landmark_update import measure_sizes, observed, remove_landmarks
from objslam.live.mapper.state import MapState
from objslam.sources.journal.corrections import AssociationMessage

_GONE = 0.1
"""A landmark leaves the map if the association gives at most this share of its rays to objects. Such landmarks come from
things that move and from false boxes. A larger share drops more landmarks."""
_LATER = -2  # The index of a ray that the association does not know. The index of a ray without an object is -1.


@dataclass(frozen=True)
class Plan:
    """What an association changes.

    owner: (R,) the id of the landmark of each ray in the session's table, -1 for a ray without a landmark. used: (R,) which
    rays are in the graph. objects: (N,) the objects of the association that have a ray in the table. ids: (N,) the id of the
    landmark of each object. new: (N,) whether this landmark is not in the map yet. heirs: for the id of a landmark, the id
    of the landmark that gets most of its rays, or -1 for none. gone: (n,) the ids of the landmarks that leave the map.
    """

    owner: Ints
    used: Bools
    objects: Ints
    ids: Ints
    new: Bools
    heirs: dict[int, int]
    gone: Ints


def plan_of(m: MapState, found: AssociationMessage) -> Plan:
    """Return what an association changes in the map. This function does not change the map.

    Objects and landmarks are paired one to one, so that the pairs share the most rays. An object with a partner keeps the id
    of this landmark. Rays that came after the association follow the other rays of their landmark.
    """
    rays, landmarks = m.rays, m.landmarks
    groups = (found.free, *found.rays)
    numbers, index = np.concatenate(groups), np.full(len(rays.number), _LATER)
    there = np.isin(numbers, rays.number)
    of = np.repeat(np.arange(-1, len(found.rays)), [len(group) for group in groups])
    index[np.searchsorted(rays.number, numbers[there])] = of[there]
    index[~m.kinds.classes(rays.label)] = _LATER  # Meanwhile, a label may have become a name, or moving.
    objects, answered = np.unique(index[index >= 0]), index > _LATER
    index = np.where(index >= 0, np.searchsorted(objects, index), index)
    held, count = answered & (rays.owner >= 0), len(objects)
    cells = (index[held] + 1) * len(landmarks) + m.rows_of(rays.owner[held])
    shared = np.bincount(cells, minlength=(count + 1) * len(landmarks)).reshape(count + 1, len(landmarks))
    ids = np.full(count, -1)
    one, other = linear_sum_assignment(shared[1:], maximize=True)
    some = shared[1 + one, other] > 0
    ids[one[some]] = landmarks.id[other[some]]
    new = ids < 0
    ids[new] = m.next_id.landmark + np.arange(new.sum())
    total, explained = shared.sum(axis=0), shared[1:].sum(axis=0)
    heirs = dict.fromkeys(landmarks.id[total > 0].tolist(), -1)
    for row in np.flatnonzero(explained > _GONE * total).tolist():
        heirs[int(landmarks.id[row])] = int(ids[shared[1:, row].argmax()])
    owner, used = rays.owner.copy(), rays.used.copy()
    owner[answered] = np.append(ids, -1)[index[answered]]
    later = np.flatnonzero(~answered & (rays.owner >= 0))
    owner[later] = [heirs.get(j, j) for j in rays.owner[later].tolist()]
    used[answered] = True
    used &= owner >= 0
    gone = landmarks.id[np.isin(landmarks.id, list(heirs)) & ~np.isin(landmarks.id, owner)]
    return Plan(owner, used, objects, ids, new, heirs, gone)


def adopt(m: MapState, found: AssociationMessage) -> tuple[int, int, int]:
    """Correct the map by an association of the drive so far.

    A keyframe that the association does not know moves like the last known keyframe before it. A landmark that the
    association does not know moves like the last keyframe that saw it. The new map depends only on the old map and the
    arguments, so a resumed session makes the same map. Return three numbers: the landmarks that became one with others, that
    left the map, and that entered it.
    """
    m.graph.refresh()
    m.read_positions()
    to_map = _place_keyframes(m, found)
    if to_map is None:
        return 0, 0, 0
    plan, rays = plan_of(m, found), m.rays
    changed = (plan.owner != rays.owner) | (plan.used != rays.used)
    m.graph.drop_rays(rays.number[changed & rays.used])
    rays.owner[:], rays.used[:] = plan.owner, plan.used
    rays.to_centre[changed] = rays.centre_sigma[changed] = 0.0
    _update_landmarks(m, plan, found.positions[plan.objects] @ to_map[:3, :3].T + to_map[:3, 3])
    added = np.flatnonzero(changed & rays.used)
    bodies = added[m.landmarks.shape[m.rows_of(rays.owner[added])] > 0]
    if len(bodies):
        rays.to_centre[bodies], rays.centre_sigma[bodies] = m.to_centres(bodies)
    m.graph.add_rays(m.bearings(added))
    _forget_old_ids(m, plan)
    _release(m)
    remove_landmarks(m, m.rows_of(plan.gone), rebuild=False)
    _solve(m)
    merged = sum(plan.heirs[j] >= 0 for j in plan.gone.tolist())
    return merged, len(plan.gone) - merged, int(plan.new.sum())


def _solve(m: MapState) -> None:
    """Solve the corrected map at once, by one step. One step is enough, because the association has already solved the
    drive. Relinearisations follow."""
    m.graph.rebuild()
    m.read_positions()
    m.schedule.relinearise_soon()


def _place_keyframes(m: MapState, found: AssociationMessage) -> Floats | None:
    """Move keyframes, landmarks and tracks to the path of an association. Return the pose (4, 4) of the association's frame
    in the map, or None if the map has no keyframe of the association.

    Without a localisation, the path of the association is laid on the first keyframe, which the graph holds.
    """
    k = m.keyframes
    order = m.time_order()
    place = np.searchsorted(found.keyframes, k.id[order]).clip(max=max(len(found.keyframes) - 1, 0))
    known = np.flatnonzero(found.keyframes[place] == k.id[order]) if len(found.keyframes) else np.zeros(0, dtype=np.int64)
    if not len(known):
        return None
    poses, answer = m.graph.poses(k.id[order]), found.map_T_camera[place]
    to_map = np.eye(4) if k.localized.any() else np.asarray(poses[known[0]] @ inverse(answer[known[0]]))
    before = known[(np.searchsorted(known, np.arange(len(order)), side="right") - 1).clip(min=0)]
    moved = (to_map @ answer[before]) @ inverse(poses[before])
    stamps = k.stamp[order]

    def at(last: Floats) -> Floats:
        """Return the motions (n, 4, 4) of things that were last seen at the stamps (n,), s."""
        return np.asarray(moved[(np.searchsorted(stamps, last, side="right") - 1).clip(min=0)])

    landmarks = m.landmarks
    carried = at(landmarks.last)
    points = np.einsum("nij,nj->ni", carried[:, :3, :3], landmarks.position) + carried[:, :3, 3]
    landmarks.yaw[:] += np.arctan2(carried[:, 1, 0], carried[:, 0, 0])
    m.graph.set_estimate(k.id[order], moved @ poses, landmarks.id, points)
    landmarks.position[:] = points
    for track in m.tracks:
        track.move(at(np.array([track.last]))[0])
    return to_map


def _update_landmarks(m: MapState, plan: Plan, positions: Floats) -> None:
    """Add the new landmarks, and describe all landmarks of the association by their rays. positions: (N, 3), m, of the
    association's objects."""
    landmarks, rays, k = m.landmarks, m.rays, m.keyframes
    expected = dict(zip(landmarks.id.tolist(), landmarks.expected.tolist(), strict=True))
    inherited: Counter[int] = Counter()
    for j, heir in plan.heirs.items():
        inherited[heir] += expected[j]
    m.next_id.landmark += int(plan.new.sum())
    for j, is_new, position in zip(plan.ids.tolist(), plan.new.tolist(), positions, strict=True):
        mine = np.flatnonzero((rays.owner == j) & rays.used)
        at = np.searchsorted(k.id, rays.keyframe[mine])
        last = at[k.stamp[at].argmax()]
        columns = observed(m.sight(mine), position) | {
            "drift": k.drift[last],
            "first": float(k.stamp[at].min()),
            "last": float(k.stamp[last]),
            "expected": max(inherited[j], len(mine)),
        }
        if is_new:
            landmarks.add(
                id=[j], label=[int(np.bincount(rays.label[mine]).argmax())], **{name: [one] for name, one in columns.items()}
            )
            m.graph.add_landmark(j, position)
            continue
        row = int(np.searchsorted(landmarks.id, j))
        if landmarks.shape[row]:  # In the association, the position is where rays meet. Here it is the centre of a body.
            columns["position"] = position = landmarks.position[row]
        for name, value in columns.items():
            getattr(landmarks, name)[row] = value
        m.graph.place(j, position)
    measure_sizes(m, m.rows_of(plan.ids))


def _forget_old_ids(m: MapState, plan: Plan) -> None:
    """Move the evidence about merged landmarks to the landmark that stays."""
    together: Counter[tuple[int, int]] = Counter()
    for pair, number in m.pairs.together.items():
        one, other = sorted(plan.heirs.get(j, j) for j in pair)
        if 0 <= one < other:
            together[one, other] += number
    m.pairs.together = together
    m.pairs.apart.clear()
    heirs = {track: plan.heirs.get(j, j) for track, j in m.landmark_of_track.items()}
    m.landmark_of_track = {track: j for track, j in heirs.items() if j >= 0}


def _release(m: MapState) -> None:
    """Take the rays of landmarks out of the tracks. A track that loses more than half of its rays is dropped."""
    owned = set(m.rays.number[m.rays.owner >= 0].tolist())
    kept = []
    for track in m.tracks:
        rays = [ray for ray in track.rays if ray[0] not in owned]
        if 2 * len(rays) >= len(track.rays) and rays:
            track.rays = rays
            kept.append(track)
    m.tracks = kept
