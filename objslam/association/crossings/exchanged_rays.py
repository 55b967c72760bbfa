"""Let the appearance of boxes decide between close landmarks that have exchanged rays."""

from collections.abc import Callable
from dataclasses import replace

from objslam.association.appearance.evidence import learn_ratio
from objslam.association.gating import explained
from objslam.association.landmarks import State

_COOLING = (20.0, 10.0, 5.0, 3.0, 2.0)
"""The factors on the noise of the rays while an association is annealed. A larger first factor lets the appearance move more
rays, and more factors take longer. In simulated clusters, a first factor of 20 mends more exchanges than 10, and 10 more
than 5."""


def learned(state: State) -> State:
    """Return the state with a ratio of appearances that is learnt from its present landmarks."""
    obs = state.obs
    ratio = learn_ratio(obs, obs.frame, obs.track, state.matched, len(state.unassigned))
    return state if ratio is state.ratio is None else replace(state, ratio=ratio)  # A new state would compute all again.


def annealed(state: State, gate: float, settle: Callable[[State], State]) -> State:
    """Assign the rays of close landmarks again, first by their appearance and then more and more by their position.

    Two close landmarks may have exchanged some rays. Then both landmarks lie between the objects, and no single ray fits the
    other landmark better. If the assumed noise of the rays is larger than the real noise, the appearance decides
    (deterministic annealing, Rose 1998). Each label keeps its earlier landmarks if the new ones explain its rays no better.
    """
    obs, begin = state.obs, learned(state)
    if begin.ratio is None:
        return begin
    now = begin
    for times in _COOLING:
        hot = replace(obs, sigma=obs.sigma * times, position_sigma=obs.position_sigma * times)
        now = settle(replace(now, obs=hot))
    now = learned(settle(replace(now, obs=obs)))
    before, after = (explained(one, gate) for one in (replace(begin, ratio=now.ratio), now))
    better = after > before
    return replace(begin.keep(~better[begin.label]).joined(now.keep(better[now.label])), ratio=now.ratio)
