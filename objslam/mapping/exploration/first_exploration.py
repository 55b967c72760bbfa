"""Find a first association of a log without a localisation."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from objslam.mapping.exploration.second_exploration import surface_of
from objslam.mapping.moves.missed_loops import largest_copy

if TYPE_CHECKING:
    from objslam.graph.init_unknown_correspondences import InitialEstimate
    from objslam.mapping.joint.joint_alternation import JointState


def explored(state: JointState, filtered: bool = True) -> tuple[InitialEstimate, bool]:
    """Explore a log without a localisation. Return a first association, and whether the filter for logs with ranges is sure
    of it. The filter is not sure if its map shows the same things at several places. filtered: whether to try this
    filter."""
    from objslam.graph import ekf_exploration
    from objslam.graph.init_unknown_correspondences import initialize_unknown

    exploring = partial(state.progress, "explore")
    if filtered and np.isfinite(state.rays.range).any():
        surface = 0.0 if state.errors is None else surface_of(state.errors, state.theta)
        start = ekf_exploration.explore(state.keyframes, state.rays, state.settings, exploring, state.errors, surface)
        found = start.association, start.positions, start.map_T_camera
        if ekf_exploration.is_sure(start) and not largest_copy(state.rays, *found, state.settings.association):
            return start, True
    return initialize_unknown(state.keyframes, state.rays, state.cameras, state.settings, exploring), False


def solved_if_sure(state: JointState, start: InitialEstimate, sure: bool) -> tuple[JointState, InitialEstimate]:
    """Return the state and the start of its rounds. If the filter was sure of the start, the association of the start is
    solved. The returned start then has the solved poses, and the state holds the shared errors."""
    if not sure:
        return state, start
    solved = state.solve("association", start.association)
    assert solved.estimate is not None
    start = replace(start, map_T_camera=solved.solved_poses, positions=solved.estimate.positions)
    return replace(solved, hold=True, association=None), start
