"""Find boxes without an object that lie on an object, for example with another label."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from objslam.association.gating import gated_edges
from objslam.association.observations import overlap
from objslam.core.arrays import Bools, Ints
from objslam.mapping.doubts.chance import LEAST_LOG_ODDS, crowded
from objslam.mapping.doubts.evidence import Evidence

_FEWEST = 5
"""The fewest boxes of a group. A larger number finds fewer groups."""
_AROUND = 9.0
"""The limit of the surroundings of an object, as a multiple of its gate. Both are squared deviations. The number of boxes in
the surroundings shows how many boxes lie on the object by chance. A larger multiple gives a surer estimate, from a larger
area."""
_SAME = 0.5
"""The least intersection over union of two boxes in one frame that show one thing. With a larger overlap, fewer boxes lie on
an object."""


def on_objects(evidence: Evidence, left: Ints) -> Iterator[tuple[int, Ints]]:
    """Yield a landmark, and the rays of one label that lie on the landmark and have no object. Several labels may lie on one
    landmark, which is yielded once for each of them.

    If a landmark has a box of its own elsewhere in the image, a ray at the landmark shows a neighbour, and does not lie on
    the landmark. If most rays of a label at a landmark show a neighbour, no ray of the label lies on the landmark.

    left: (M,) the rays without an object.
    """
    state, gate = evidence.state, evidence.gate
    if not state.count or not len(left):
        return
    labels = len(state.unassigned)
    every = replace(state.landmarks, accepts=np.ones((state.count, labels), dtype=bool))
    edges = gated_edges(state.obs.take(left), every, _AROUND * gate)
    order = np.lexsort((edges.deviation, edges.ray))
    order = order[np.append(True, np.diff(edges.ray[order]) > 0)[: len(order)]]
    ray, landmark, inside = left[edges.ray[order]], edges.landmark[order], edges.deviation[order] <= gate
    key = landmark * labels + state.obs.label[ray]
    pairs, group = np.unique(key, return_inverse=True)
    around, number = np.bincount(group, minlength=len(pairs)), np.bincount(group[inside], minlength=len(pairs))
    odds = crowded(number, around, 1 / _AROUND, max(len(pairs), 1))
    elsewhere = _elsewhere(evidence, ray, landmark) & inside
    beside = 2 * np.bincount(group[elsewhere], minlength=len(pairs)) > number
    for one in np.flatnonzero((number >= _FEWEST) & (odds > LEAST_LOG_ODDS) & ~beside):
        yield int(pairs[one] // labels), ray[(group == one) & inside & ~elsewhere]


def _elsewhere(evidence: Evidence, ray: Ints, landmark: Ints) -> Bools:
    """Return whether each landmark (E,) has a box in the frame of a ray (E,) that shows another thing than the ray's box."""
    state = evidence.state
    obs, frames = state.obs, len(state.view.camera)
    own = np.lexsort((obs.frame[state.assigned], state.owner))
    key = state.owner[own] * frames + obs.frame[state.assigned][own]
    wanted = landmark * frames + obs.frame[ray]
    at = np.minimum(np.searchsorted(key, wanted), max(len(key) - 1, 0))
    found = np.flatnonzero(key[at] == wanted) if len(key) else np.zeros(0, dtype=np.int64)
    elsewhere = np.zeros(len(ray), dtype=bool)
    theirs = obs.box[state.assigned[own[at[found]]]]
    elsewhere[found] = overlap(obs.box[ray[found]], theirs) < _SAME
    return elsewhere
