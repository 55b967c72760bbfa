"""Which labels a detector gives to one thing now and then."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from objslam.association.evidence import stray_share
from objslam.association.extent import grouped_median
from objslam.association.landmarks import State, sizes
from objslam.association.matches import gated_edges
from objslam.association.sightings import Sightings
from objslam.association.visibility import View, Visits
from objslam.types import Bools

SIZE_RATIO = 2.0
"""What has two labels has one size, up to this factor."""
_FEWEST = 3  # boxes
_BY_CHANCE = 1e-3  # how many labels may be adopted wrongly


def adopted(s: Sightings, state: State, visits: Visits, view: View, gate: float) -> Bools:
    """Which labels each landmark accepts (N, L) once those are added whose free boxes it explains, in its size.

    A label is added where more of its boxes lie on a landmark, in frames in which that has none, than strays would, and
    fewer than it has.
    """
    from scipy.stats import poisson

    accepts = state.landmarks.accepts
    count, labels = accepts.shape
    free = s.take(state.matched < 0)
    everything = replace(state.landmarks, accepts=np.ones_like(accepts))
    edges = gated_edges(free, everything, gate)
    frames = int(s.frame.max(initial=0)) + 1
    held = np.flatnonzero(state.matched >= 0)
    taken = np.unique(state.matched[held] * frames + s.frame[held])
    missed = ~np.isin(edges.landmark * frames + free.frame[edges.ray], taken)
    ray, landmark = edges.ray[missed], edges.landmark[missed]
    pair = landmark * labels + free.label[ray]
    number = np.bincount(pair, minlength=count * labels).reshape(count, labels)

    away = np.linalg.norm(state.landmarks.position[landmark] - free.origin[ray], axis=1)
    size = grouped_median(np.sqrt(free.size[ray].prod(axis=1)) * away, pair, count * labels).reshape(count, labels)
    ratio = size / np.maximum(sizes(s, state), 1e-9)[:, None]
    strays = np.bincount(free.label, minlength=labels)
    expected = stray_share(s, state, visits, view, gate)[:, None] * strays
    surprising = poisson.sf(number - 1, expected) * max(count * labels, 1) < _BY_CHANCE
    few = (number >= _FEWEST) & (number < state.number[:, None])
    return np.asarray(accepts | (surprising & few & (ratio < SIZE_RATIO) & (ratio > 1 / SIZE_RATIO)))
