"""Find the other labels that a detector sometimes gives to an object."""

from dataclasses import replace

import numpy as np

from objslam.association.duplicates import show_one_thing
from objslam.association.existence import stray_share
from objslam.association.gating import gated_edges
from objslam.association.landmarks import State
from objslam.core.arrays import Bools
from objslam.core.statistics import grouped_median, poisson_tail

SIZE_RATIO = 2.0
"""The largest ratio between the sizes of boxes of two labels that show one object. A larger ratio fuses more labels."""
_MIN_BOXES = 3
"""The fewest boxes of another label that a landmark needs to accept the label. A larger number fuses fewer labels."""
_MOST_BY_CHANCE = 1e-3  # The most labels accepted by chance in a log, on average. A larger value fuses more labels.


def fused_labels(state: State, gate: float) -> Bools:
    """Return which labels (N, L) each landmark accepts: its own label, and labels whose unassigned boxes it explains.

    An explained box lies on the landmark, in a frame in which no box belongs to the landmark. The explained boxes of a label
    must have the landmark's size. There must be more explained boxes than by chance, and fewer than the landmark's own
    boxes.

    If the detector misses the landmark, boxes of a thing right beside it are also explained. But this thing also has boxes
    in frames with a box of the landmark. So the boxes of the label that lie on the landmark, but beside its own box, show
    what to expect by chance. Boxes on its own box do not count, because a detector may draw one thing twice.
    """
    obs, accepts = state.obs, state.landmarks.accepts
    if accepts.all() or not len(state.owner):  # There is no other label, or no landmark.
        return accepts
    count, labels = accepts.shape
    free = obs.take(state.matched < 0)
    edges = gated_edges(free, replace(state.landmarks, accepts=np.ones_like(accepts)), gate)
    frames = int(obs.frame.max(initial=0)) + 1
    taken, sought = state.owner * frames + obs.frame[state.assigned], edges.landmark * frames + free.frame[edges.ray]
    order = np.argsort(taken)
    at = np.minimum(np.searchsorted(taken[order], sought), len(order) - 1)
    missed = taken[order][at] != sought
    pair = edges.landmark * labels + free.label[edges.ray]
    own, box = obs.box[state.assigned][order][at], free.box[edges.ray]
    beside = ~missed & ~show_one_thing(own, box)
    number, neighbours = (
        np.bincount(pair[some], minlength=count * labels).reshape(count, labels) for some in (missed, beside)
    )
    ray, landmark, pair = edges.ray[missed], edges.landmark[missed], pair[missed]
    away = np.linalg.norm(state.landmarks.position[landmark] - free.origin[ray], axis=1)
    size = grouped_median(np.sqrt(free.size[ray].prod(axis=1)) * away, pair, count * labels).reshape(count, labels)
    ratio = size / np.maximum(state.size, 1e-9)[:, None]
    expected = np.maximum(stray_share(state, gate)[:, None] * state.unassigned, neighbours)
    surprising = poisson_tail(number, expected) * max(count * labels, 1) < _MOST_BY_CHANCE
    few = (number >= _MIN_BOXES) & (number < state.ray_count[:, None])
    return np.asarray(accepts | (surprising & few & (ratio < SIZE_RATIO) & (ratio > 1 / SIZE_RATIO)))
