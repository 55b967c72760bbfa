"""Close loops that an exploration missed. A later visit has copies of older landmarks, and is moved onto these landmarks."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from objslam.core.statistics import grouped_median
from objslam.errors import SolveError
from objslam.mapping.joint.merge_and_split import joined

if TYPE_CHECKING:
    from objslam.config import AssociationSettings
    from objslam.core.arrays import Floats
    from objslam.core.types import Association, Rays
    from objslam.graph.loop_closure import Closure, Landmarks
    from objslam.mapping.joint.joint_alternation import JointState

    Attempts = dict[tuple[bytes, bytes], JointState | None]
    """The attempts at closures of one state. The key has the landmarks `now` and `before` of a closure. The value is None if
    the closure has no solution."""

_BY_CHANCE = 5
"""The largest number of landmarks of a map that may have the relative positions of others by chance. With more such
landmarks, a part of the map is a copy. With a larger number, small copies are not noticed. With a smaller number, rows of
equal things look like copies, and other starts take time."""
_COMPARED = 2
"""The number of loops that are compared before one is closed. They are those with the most evidence, and each takes a solve.
With a larger number, the search is slower, and fewer wrong loops are closed."""
_TRIED = 4
"""The most loops that are tried before the search ends. Loops with more evidence are tried first. Each takes a solve. A
larger number closes more loops, and takes longer on maps that have missed none."""


def with_missed_loops(state: JointState) -> JointState:
    """Return the state after closures of loops that the exploration missed, if these explain the log better.

    An unlikely slip, or one landmark that was taken for another, bends the path by more than the exploration allows for. All
    later visits then have landmarks of their own, all rays agree, and no round of association and solve brings the visits
    together. The copies of the landmarks still have the relative positions of the first ones, which reveal the loop.

    A closure joins landmarks and is solved at once, at held shared errors. The rounds of association follow after the last
    closure. Earlier rounds would give the rays of visits that are not closed yet to wrong landmarks. First, loops are closed
    one by one, and each closure must explain the log better. Then all loops are closed that copies of relative positions
    show. state: without a localisation.
    """
    held = replace(state, hold=state.errors is not None)
    best = held
    solved: Attempts = {}
    while not best.spent and (closed := _with_a_loop(best, solved)) is not None:
        best, solved = closed, {}
    if best is not held:
        solved = {}  # These were closures of another state.
        try:
            best = state.better(best.released(state.hold))
        except SolveError:  # The map without the closures is there.
            best = state
        if best is not state:
            state = _with_rounds(best)
    return _with_all_loops(state, solved)


def _with_all_loops(state: JointState, solved: Attempts) -> JointState:
    """Return the state after closures of all loops that copies show, and rounds, if these explain the log better.

    A single closure may explain the log worse. Some rays of a later visit belong to wrong landmarks of an earlier one, and
    fit only the bent path. The rounds free these rays, but only if all parts of the path are in the right place. Other
    objects are not merged after a closure, because landmarks of parts that are not closed yet stand between the others.

    solved: the closures of this state that are solved already.
    """
    best = replace(state.attempt(), hold=state.errors is not None)
    for _ in range(0 if best.spent else _TRIED):
        landmarks, middle = _of_state(best)
        copies = _copies(landmarks, middle, best.solved_poses, state.settings.association)
        tried = [_closed(best, closure, landmarks, solved) for closure in copies[:_COMPARED]]
        closed = [one for one in tried if one is not None]
        if not closed:
            break
        best, solved = max(closed, key=lambda one: one.explained), {}
    if best.association is state.association:
        return state
    assert best.association is not None
    assert best.estimate is not None
    try:
        best = best.alternated(best.estimate.map_T_base, (best.association, best.estimate.positions)).released(state.hold)
    except SolveError:  # The map with the copies is there.
        return state
    return state.better(best)


def largest_copy(
    rays: Rays, association: Association, positions: Floats, map_T_camera: Floats, of: AssociationSettings
) -> int:
    """Return the number of landmarks in the largest part of a map that is a copy of another part at another place. A map
    with a copy has missed a loop. Without a copy, the number is 0.

    All rays can agree with such a map. A copy is sure if more than `_BY_CHANCE` landmarks have the relative positions of
    others, with the evidence of a loop (`_copies`). positions: (N, 3) m, NaN if unknown. map_T_camera: (K, 4, 4)."""
    if len(np.unique(association.label)) == association.count:  # Of each label there is one object.
        return 0
    copies = _copies(*_landmarks(rays, association, positions, map_T_camera, of.min_rays), map_T_camera, of)
    return max((len(loop.now) for loop in copies), default=0)


def largest_copy_in(state: JointState) -> int:
    """Return the number of landmarks in the largest copy in the map of a state (`largest_copy`)."""
    assert state.association is not None
    assert state.estimate is not None
    positions = np.where(state.estimate.solved[:, None], state.estimate.positions, np.nan)
    return largest_copy(state.rays, state.association, positions, state.solved_poses, state.settings.association)


def _copies(landmarks: Landmarks, middle: Floats, map_T_camera: Floats, of: AssociationSettings) -> list[Closure]:
    """Return the loops that copies show, with the most evidence first. middle: (N,) as from `_landmarks`. map_T_camera: (K,
    4, 4).

    Among many searches, one may find a loop by chance. So the evidence must exceed that for a single search
    (`association.loop_evidence`) by the logarithm of the number of searches (Bonferroni). Where things repeat, like the
    doors of a corridor, the evidence must also exceed that of certainly wrong matches by `association.loop_lead`."""
    from objslam.graph.loop_closure import SEARCHES, find_missed_closures

    enough = of.loop_evidence + np.log(SEARCHES)
    found = find_missed_closures(landmarks, middle, map_T_camera, enough)
    sure = [loop for loop in found if len(loop.now) > _BY_CHANCE and loop.evidence >= enough]
    return [loop for loop in sure if loop.evidence - max(loop.repeated, 0.0) >= of.loop_lead]


def _with_rounds(state: JointState) -> JointState:
    """Return the state after rounds of association, if they explain the log better."""
    assert state.association is not None
    assert state.estimate is not None
    try:
        found = state.attempt().alternated(state.estimate.map_T_base, (state.association, state.estimate.positions))
    except SolveError:  # The map before the rounds is there.
        return state
    return state.better(found)


def _with_a_loop(state: JointState, solved: Attempts) -> JointState | None:
    """Return the state after the closure of one loop that explains the log better. Return None if there is no such loop.
    solved: each closure that is tried is added here."""
    from objslam.graph.loop_closure import find_missed_closures

    landmarks, middle = _of_state(state)
    for closure in find_missed_closures(landmarks, middle, state.solved_poses)[:_TRIED]:
        closed = _closed(state, closure, landmarks, solved)
        if closed is not None and closed.explained > state.explained:
            return closed
    return None


def _of_state(state: JointState) -> tuple[Landmarks, Floats]:
    """Return what `_landmarks` returns, for the rays that agree with the map of a state."""
    assert state.association is not None
    assert state.estimate is not None
    agreed = replace(state.association, object=np.where(state.agree, state.association.object, -1))
    positions = np.where(state.estimate.solved[:, None], state.estimate.positions, np.nan)
    return _landmarks(state.rays, agreed, positions, state.solved_poses, state.settings.association.min_rays)


def _landmarks(
    rays: Rays, association: Association, positions: Floats, map_T_camera: Floats, min_rays: int
) -> tuple[Landmarks, Floats]:
    """Return the landmarks of a map, and the median keyframe (N,) of each landmark's rays. It is NaN without enough rays."""
    from objslam.graph.loop_closure import Landmarks, covariances_at

    label, position, owner = association.label, np.nan_to_num(positions), association.object
    held = np.flatnonzero(owner >= 0)
    landmarks = Landmarks.none().and_also(position, covariances_at(rays, owner, position, map_T_camera), label)
    landmarks.see(rays.keyframe, owner, held, np.searchsorted(rays.keyframe, np.arange(len(map_T_camera) + 1)))
    middle = grouped_median(rays.keyframe[held].astype(float), owner[held], len(label))
    enough = (landmarks.rays >= min_rays) & np.isfinite(positions[:, 0])
    return landmarks, np.where(enough, middle, np.nan)


def _closed(state: JointState, closure: Closure, landmarks: Landmarks, solved: Attempts) -> JointState | None:
    """Return an attempt after the solve of a closure. Return None if it has no solution. solved: the closures of this state
    that are solved already, which are not solved again."""
    which = closure.now.tobytes(), closure.before.tobytes()
    if which not in solved:
        solved[which] = _solved(state, closure, landmarks)
    return solved[which]


def _solved(state: JointState, closure: Closure, landmarks: Landmarks) -> JointState | None:
    """Return an attempt after the solve of a closure. None if it has no solution."""
    from objslam.graph.loop_closure import closed_path, heading_variance

    assert state.association is not None
    assert state.keyframes.drift is not None
    into = np.arange(state.association.count)
    into[closure.now] = closure.before
    found = joined(state.association, into)
    poses = closed_path(closure, landmarks, state.solved_poses, heading_variance(state.keyframes.drift))
    attempt = state.attempt().counted(found)
    try:
        return attempt.solve("merge", found, poses)
    except SolveError:  # The closure bends the path too far.
        return None
