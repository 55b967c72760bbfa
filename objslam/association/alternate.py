"""Alternate between the assignment of rays to landmarks and the refinement of the landmarks."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from objslam.association.gating import Edges, best_assignment, gated_edges, track_bonus
from objslam.association.landmarks import State
from objslam.association.refinement import refine
from objslam.core.arrays import Bools, Floats

_TIMES = 3  # The most alternations after a change. A larger value converges further.
_FAR = 1e6  # The distance (m) from the first camera beyond which only parallel rays meet.


def alternate(
    state: State,
    gate: float,
    plausible: Callable[[State], Bools],
    times: int = _TIMES,
    unmatched: Callable[[State, Edges], Floats] | None = None,
) -> State:
    """Alternate between assignment and refinement until no ray changes its landmark, at most `times` times.

    plausible: returns which landmarks (N,) stay. unmatched: returns the cost (E,) of a ray without a landmark, instead of
    each match. Without it, this cost is the gate.
    """
    for _ in range(times):
        obs, old, before = state.obs, state.landmarks, state.matched
        edges = gated_edges(obs, old, gate)
        most = gate
        cost = edges.cost - track_bonus(edges, obs.track, before)
        if unmatched is not None:
            cost, most = cost - unmatched(state, edges), 0.0
        matched = best_assignment(edges, cost, obs.frame, most)
        held = np.flatnonzero(matched >= 0)
        position = refine(obs, held, matched[held], old.position, old.noise)
        state = State(obs, state.view, replace(old, position=position), matched)
        stays = plausible(state)
        state = replace(state, landmarks=replace(state.landmarks, noise=state.noise)).keep(stays)
        if np.array_equal(matched, before):
            break
    return state


def near(state: State) -> Bools:
    """Return which landmarks (N,) are not so far away that only parallel rays meet there."""
    return np.asarray((np.abs(state.landmarks.position - state.obs.origin[:1]) < _FAR).all(axis=1))
