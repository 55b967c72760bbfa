"""Assign the rays of a solved log again, along the most likely path through its map."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Self

import numpy as np

from objslam.association.nearest_neighbour import assign
from objslam.association.observations import PosedRays, observe
from objslam.association.path_search.most_likely_path import PathSearch
from objslam.association.visibility import detection_history, frames_of
from objslam.core.arrays import Floats
from objslam.core.types import Association, Keyframes, Rays
from objslam.mapping.solution import rays_moved

if TYPE_CHECKING:
    from objslam.core.estimate import Estimate
    from objslam.mapping.joint.joint_alternation import JointState

_STILL = 0.01
"""The largest share of rays that change their object in the last round along the most likely path. With a larger share, the
rounds end sooner. The share is not zero, because the path is rounded to a grid, so a few rays change in every round."""
_WORSE = 2
"""The number of consecutive rounds without improvement after which the rounds along the most likely path end. A larger
number takes longer, but gets over more rounds in which close objects merge."""


def relocalized(begin: JointState) -> JointState:
    """Return the state after rounds along the most likely path through the map, if this state is `better`. Otherwise return
    the given state. The given state is also returned if the search has taken all its solves.

    The rounds of `JointState.alternated` keep a path that is bent onto wrong landmarks, because all its rays agree. So each
    round here begins with another path. This is the most likely path if any ray may belong to any landmark. Every second
    round holds the shared errors and the noise, because one round changes them little.
    """
    if begin.keyframes.odom_T_base is None or begin.keyframes.localized_every or begin.spent:
        return begin
    state, worse = begin.attempt(), 0
    best = state
    for number in range(begin.settings.joint.max_rounds):
        begin.progress(f"most likely path, round {number + 1}", 0, 0)
        assert state.association is not None
        assert state.estimate is not None
        before = state.association
        search = Relocalization.of(state)
        if search is None:
            break
        path, objects = search.found()
        association = state.associated(path, (objects, state.estimate.positions), rough=True)
        if rays_moved(before.object, association.object) <= _STILL * len(state.rays):
            break
        start = path @ state.keyframes.base_T_camera
        state = replace(state, hold=begin.hold or (begin.errors is not None and number % 2 == 1))
        state = state.counted(association).solve("association", association, start).merged()
        # Close objects may merge in one round, and separate again in a later round.
        best, worse = (state, 0) if state.explained > best.explained else (best, worse + 1)
        if worse == _WORSE or state.spent:
            break
    if best.association is begin.association:
        return begin
    if best.hold != begin.hold:
        best = best.released(begin.hold)
    assert best.association is not None
    assert best.estimate is not None
    turns = best.alternated(best.estimate.map_T_base, (best.association, best.estimate.positions))
    if turns.explained < best.explained:
        turns = replace(turns.continued_from(best), unsettled=turns.unsettled)
    return begin.better(turns)


@dataclass(frozen=True)
class Relocalization:
    """A search for the most likely path through the map of a solved state, and for the objects of the rays along it.

    Build it with `of`.
    """

    state: JointState
    search: PathSearch

    @classmethod
    def of(cls, state: JointState) -> Self | None:
        """Prepare the search. Return None if no label has two objects that could be confused."""
        keyframes, rays, association, estimate = _solved(state)
        position = estimate.positions
        if not len(position):
            return None
        held = np.where(state.agree & np.isfinite(position[:, 0])[association.object], association.object, -1)
        obs, ray, keyframe = observe(PosedRays(rays, keyframes, state.cameras, state.solved_poses, rays.sigma))
        view = frames_of(keyframes, keyframe, state.cameras, state.solved_poses, state.settings, cut=rays.cut)
        history = detection_history(obs, held[ray], np.nan_to_num(position), association.label, view)
        rate = history.seen / np.maximum(history.expected, 1)
        search = PathSearch.of(keyframes, rays, estimate.map_T_base, position, association.label, rate)
        return None if search is None else cls(state, search)

    def found(self, without: int | None = None) -> tuple[Floats, Association]:
        """Return the path (K, 4, 4) map_T_base, and the objects of the rays along it.

        The objects stay the same, but may lose all their rays. without: an object that is taken out of the map.
        """
        keyframes, rays, association, estimate = _solved(self.state)
        if without is None:
            path = self.search.path()
        else:
            path = self.search.path_without(without, self.state.agree & (association.object == without))
        taken_out = np.arange(association.count) == without
        objects = assign(
            rays,
            np.where(taken_out[:, None], np.nan, estimate.positions),
            np.nan_to_num(estimate.covariance),
            association.label[:, None] == np.arange(len(rays.label_names)),
            path.map_T_base @ keyframes.base_T_camera,
            rays.sigma,
            pose_covariance=np.broadcast_to(path.pose_covariance, (len(keyframes), 6, 6)),
        )
        return path.map_T_base, Association(objects, association.label)


def _solved(state: JointState) -> tuple[Keyframes, Rays, Association, Estimate]:
    """Return the keyframes, the rays, the association and the estimate of a solved state."""
    assert state.association is not None
    assert state.estimate is not None
    return state.keyframes, state.rays, state.association, state.estimate
