"""Drop phantoms: objects where rays of several things meet at poses that err."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from objslam.mapping.relocalization import relocalize

if TYPE_CHECKING:
    from objslam.core.arrays import Ints
    from objslam.mapping.joint_alternation import JointState

_LARGE = 1.0
"""Phantoms are searched if the errors of a localisation that last for seconds are at least this multiple of `localization`.
From this value on, the errors that last are as large as all errors should be. With a larger value, fewer maps take the time
of the search."""
_MOST = 60
"""The most objects that are tried as phantoms, those that are least likely to exist first. Each takes a search of the path
and a solve. A larger number finds more phantoms in large maps, and takes longer."""


def has_lasting_errors(state: JointState) -> bool:
    """Return whether the last solve found that the localisation errs for seconds, while odometry tells the motions."""
    if state.errors is None or not state.keyframes.localized_every or state.keyframes.odom_T_base is None:
        return False
    noise = state.errors.noise
    factors = np.array([noise.heading, noise.place]) * np.sqrt([noise.heading_share, noise.place_share])
    return bool(factors.max() >= _LARGE)


def without_phantoms(state: JointState) -> JointState:
    """Return the state without objects that make the rays worse `explained`, else the state itself.

    If headings err for seconds, a ray to one thing passes its neighbours. Rays to several things then meet at points without
    a thing, and a solve bends the path until they agree. Each ray then fits, so no round of association frees it. Here each
    object is taken out of the map in turn. The most likely path without the object gives its rays to other objects. If this
    explains the log better, the object is a phantom. The phantom whose loss explains the log best is dropped, and the other
    phantoms are tried again. The shared errors and the noise stay in these trials.
    """
    assert state.association is not None
    best = replace(state.attempt(), hold=state.errors is not None)
    best = begin = best.solve("association", state.association, state.solved_poses)
    tried = _candidates(state)
    while len(tried):
        found, phantoms = best, list[int]()
        for number, j in enumerate(tried.tolist()):
            state.progress("phantoms", number, len(tried))
            other = _without(best, j)
            if other is not None and other.explained > best.explained:
                phantoms.append(j)
                found = other if other.explained > found.explained else found
        best, tried = found, np.array(phantoms, dtype=np.int64)
        assert best.estimate is not None
        tried = tried[np.isfinite(best.estimate.positions[tried, 0])]
    if best is begin:
        return state
    assert best.association is not None
    assert best.estimate is not None
    guess = best.association, best.estimate.positions
    # Without an association, the first round is solved also if it agrees with the guess, which still lists the phantoms.
    rounds = replace(best, hold=state.hold, association=None).alternated(best.estimate.map_T_base, guess)
    return state.better(rounds)


def _candidates(state: JointState) -> Ints:
    """Return the objects that may be phantoms, the least likely first: those of labels with several objects."""
    association, estimate = state.association, state.estimate
    assert association is not None
    assert estimate is not None
    placed = np.isfinite(estimate.positions[:, 0])
    several = np.bincount(association.label[placed], minlength=association.label.max(initial=0) + 1) > 1
    found = np.flatnonzero(placed & several[association.label])
    if association.existence is not None:
        found = found[np.argsort(association.existence[found], kind="stable")]
    return found[:_MOST]


def _without(state: JointState, j: int) -> JointState | None:
    """Return the state after a solve without object `j`, with the rays along the most likely path. None without a path."""
    assert state.association is not None
    assert state.estimate is not None
    positions = state.estimate.positions.copy()
    positions[j] = np.nan
    left = replace(state.estimate, positions=positions)
    found = relocalize(state.keyframes, state.rays, state.cameras, state.settings, state.association, left)
    if found is None:
        return None
    path, association = found
    return state.counted(association).solve("association", association, path @ state.keyframes.base_T_camera)
