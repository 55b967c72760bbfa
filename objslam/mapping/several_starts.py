"""Search a log without a localisation from several starts, and take the map that explains it best."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING, Self, TypeVar

import numpy as np

from objslam.core.geometry import inverse
from objslam.errors import SolveError
from objslam.frontend.tracks import associate_tracks
from objslam.mapping.exploration.errors_of_tracks import along, with_errors_of_tracks
from objslam.mapping.exploration.first_exploration import explored, solved_if_sure
from objslam.mapping.exploration.second_exploration import finds_same_objects, with_loose_odometry
from objslam.mapping.joint.joint_alternation import Effort, JointState
from objslam.mapping.joint.relocalization import relocalized
from objslam.mapping.moves.missed_loops import largest_copy_in, with_missed_loops

if TYPE_CHECKING:
    from objslam.graph.init_unknown_correspondences import InitialEstimate

_T = TypeVar("_T")

_CLEAR = 0.98
"""The least share of agreeing rays in a clear map, among the rays of tracks. With a larger share, more logs are tried from
other starts, which takes time. In 15 simulations, right maps had 0.983 and more. Most maps that showed things twice had at
most 0.963. A bent map of a real robot with ranges had 0.976."""
_NOISIER = 1.5, 2.5
"""The largest factors on the noise of rays of a clear map. The first factor is for a map that only one start found. The
second is for a map that another start found too. Rays with wrong objects make the noise large. The factor was 3.6 and 12 in
simulated maps that showed things twice. Boxes that lie beside their things, by a share of the thing's size, also make the
noise large. With such boxes, the factor was 1.5 to 1.8 in right maps. With smaller factors, more logs are tried from other
starts."""

_AT_REST = 0.9
"""The least share of the boxes of tracks that have an object in a map without many moving things. Below it, the boxes
without an object show things that move. Other starts would then make objects of such boxes. A small share says nothing
against the path of a known start, because on a wrong path the boxes that do not fit become additional objects. Wrong maps of
a simulated drive had 0.96 and more. Right maps with people who walk had 0.8 and less. With a smaller share, more logs are
tried from other starts."""

_HOPELESS = 0.2
"""The largest share by which the first map of a start may explain less than the best map, so that the start is still
searched at the end. In simulated logs, searches raised what first maps explain by at most 13 %. With a larger share, more
starts are searched."""


def from_several_starts(
    state: JointState, known: InitialEstimate | None = None, named: JointState | None = None
) -> JointState:
    """Return the state after searches from several starts. The search ends at the first clear map. The order is a known
    start, the first exploration, and then the best of further starts.

    A search for a more likely path takes many solves, and ends after `joint.max_solves`. So a further start is searched at
    once only if its first map explains the log better than the first maps of all earlier starts. The other starts are
    searched at the end, because a poor start may lead to the best map. The one that explains most comes first. state: before
    the first association. named: the state with one object for each label, if this was tried.
    """
    state = replace(state, effort=Effort())
    found = None
    if known is not None:
        first = from_start(state.attempt(), known)
        found = _Found(first, _searched(first))
        if not found.unclear or _has_things_that_move(found.state):
            return state.replaced(found.state)
    before = state.ledger.copy()
    try:
        return _from_explorations(state, found, named)
    except SolveError:  # The map of the known start is there, whatever is wrong with the exploration.
        if found is None:
            raise
        state.ledger.restore(before)
        return state.replaced(found.state)


def _from_explorations(state: JointState, found: _Found | None, named: JointState | None) -> JointState:
    """Return the state after a search from the first exploration, and from further starts while the map is unclear. found:
    what a known start led to, None without one."""
    begin, path = with_errors_of_tracks(state)
    start, sure = explored(begin)
    first = from_start(*solved_if_sure(begin, start, sure))
    found = (_Found(first, _searched(first)) if found is None else found.beside(first)).compared(named)
    noisier = None if begin.spent else with_loose_odometry(first, begin.theta, sure)
    if noisier is not None:
        found, sure = until_interrupted(begin, (found, sure), lambda now: _with_loose_odometry(*now, noisier))

    def along_tracks() -> JointState:
        return from_start(begin.attempt(), explored(along(begin, path))[0])

    def by_windows() -> JointState:
        return from_start(begin.attempt(), explored(begin, filtered=False)[0])

    starts = [lambda: _from_tracks(begin), lambda: from_start(begin.attempt(), None), along_tracks]
    if np.isfinite(begin.rays.range).any():
        starts = [along_tracks] if not sure else [by_windows] if largest_copy_in(found.state) else []
    for other_start in starts:  # The first ones take less time.
        if not found.unclear or begin.spent:
            break
        found = until_interrupted(begin, found, partial(_Found.after, start=other_start))
    found = until_interrupted(begin, found, _Found.with_the_others)
    return replace(found.state, unfinished=begin.spent and found.unclear)


def _with_loose_odometry(found: _Found, sure: bool, noisier: JointState) -> tuple[_Found, bool]:
    """Return what is found with a start from a second exploration, and whether this exploration is sure. noisier: the state
    with more noise of the odometry."""
    other, sure = explored(noisier)
    if finds_same_objects(found.state, other.association):
        return found, sure
    return found.after(lambda: from_start(*solved_if_sure(noisier, other, sure))), sure


@dataclass(frozen=True)
class _Found:
    """What the starts of a search led to. first: the best of the first maps, one of each start. state: the best map after a
    search. left: the first maps from which no search was made yet. confirmed: whether another start led to the objects of
    `state`."""

    first: JointState
    state: JointState
    left: tuple[JointState, ...] = ()
    confirmed: bool = False

    @property
    def unclear(self) -> bool:
        """Whether the best map may be wrong, so that other starts are worth their time."""
        return _unclear(self.state, self.confirmed)

    def compared(self, other: JointState | None) -> Self:
        """Return what is found, confirmed if another map has the same objects."""
        if other is None or other.association is None or len(other.rays) != len(self.state.rays):
            return self
        return replace(self, confirmed=self.confirmed or finds_same_objects(self.state, other.association))

    def beside(self, first: JointState) -> Self:
        """Return what is found after a search from another first map. If both maps have the same objects, the best map is
        confirmed."""
        state = _searched(first)
        assert self.state.association is not None
        same = finds_same_objects(state, self.state.association)
        best = self.state if state.gain(self.state) > 0 else state
        return replace(self, first=first.better(self.first), state=state.replaced(best), confirmed=same)

    def after(self, start: Callable[[], JointState]) -> Self:
        """Return what is found with one more start. A search from this start is made only if its first map is better than
        all first maps before.

        If its first map is not better, but has the objects of the best map, it confirms the best map. A search would lead to
        the same map."""
        try:
            first = start()
            promising = self.first.gain(first) > 0
        except SolveError:  # The map so far is there, whatever is wrong with the other start.
            return self
        if promising:
            return replace(self, first=first).searched(first)
        if first.association is not None and finds_same_objects(self.state, first.association):
            return self.compared(first)
        return replace(self, left=(*self.left, first))

    def with_the_others(self) -> Self:
        """Return what is found after searches from the starts that are left. They end when the map is clear or no solves are
        left. Starts with hopeless first maps (`_HOPELESS`) are left out."""
        found = self
        for first in sorted(self.left, key=lambda one: -one.explained):
            behind = found.state.explained - first.explained
            if first.spent or behind > _HOPELESS * abs(found.state.explained) or not found.unclear:
                break
            found = found.searched(first)
        return found

    def searched(self, first: JointState) -> Self:
        """Return what is found after a search from the first map of a start. The best map is confirmed if the new map and
        the former best map have the same objects."""
        try:
            state = _searched(first)
            best = self.state.better(state)
        except SolveError:  # The map so far is there.
            return self
        if best is self.state:
            return self.compared(state)
        return replace(replace(self, confirmed=False).compared(state), state=best)


def _searched(state: JointState) -> JointState:
    """Return the state after searches for a more likely path through its map, and for loops that it missed."""
    state = improved(state, relocalized)
    return until_interrupted(state, state, with_missed_loops)


def _from_tracks(begin: JointState) -> JointState:
    """Return the state after a solve with the tracks of boxes as landmarks, and after closures of the loops between them.

    The gates of an exploration do not take part. So this start finds drives whose wheels slip more than the noise of the
    odometry says."""
    found = associate_tracks(begin.keyframes, begin.rays)
    return with_missed_loops(begin.attempt().counted(found).solve("association", found))


def _unclear(state: JointState, confirmed: bool = False) -> bool:
    """Return whether a map may be wrong, so that other starts are worth their time.

    An exploration goes wrong by chance, so another start may be right. The false boxes of a detector agree with no object
    even in the best map, but they are single boxes. So only the rays of tracks are judged, if the log has tracks. All rays
    may agree with a map that shows the same things at several places. Such a map has copies of the relative positions of
    objects. All rays may also agree because wrong objects made the estimated noise large. But the wrong maps of two starts
    differ. So some noise says nothing against objects that another start found too. confirmed: whether another start found
    them. A second exploration does not count as another start, because it goes wrong as the first one did.
    """
    noise = 1.0 if state.errors is None else state.errors.noise.rays
    tracked = associate_tracks(state.keyframes, state.rays).object >= 0
    agree = state.agree[tracked] if tracked.any() else state.agree
    return bool(agree.mean() < _CLEAR or noise > _NOISIER[confirmed] or largest_copy_in(state))


def _has_things_that_move(state: JointState) -> bool:
    """Return whether many boxes of tracks have no object (`_AT_REST`), because they show things that move."""
    assert state.association is not None
    tracked = associate_tracks(state.keyframes, state.rays).object >= 0
    return bool(tracked.any() and (state.association.object[tracked] < 0).mean() > 1 - _AT_REST)


def from_start(state: JointState, start: InitialEstimate | None) -> JointState:
    """Return the state after rounds that begin at a start. Without a start, they begin at the poses of the keyframes."""
    map_T_camera = state.keyframes.map_T_camera if start is None else start.map_T_camera
    guess = None if start is None else (start.association, start.positions)
    return state.alternated(map_T_camera @ inverse(state.keyframes.base_T_camera), guess)


def improved(state: JointState, step: Callable[[JointState], JointState]) -> JointState:
    """Return the state after a step was repeated until the step no longer found a better state. step: a function that
    returns its argument if it finds nothing better."""
    for _ in range(state.settings.joint.max_rounds):
        found = until_interrupted(state, state, step)
        if found is state:
            break
        state = found
    return state


def until_interrupted(state: JointState, found: _T, step: Callable[[_T], _T]) -> _T:
    """Return what a step of a search finds. If the user interrupts it (Ctrl-C), return what was found before, and let the
    whole search end. A second interrupt is raised. state: any state of the search. found: the argument of the step."""
    if state.effort.interrupted:
        return found
    try:
        return step(found)
    except KeyboardInterrupt:
        state.effort.interrupted = True
        state.progress("interrupted, so the best map until now is finished (Ctrl-C again gives it up)", 0, 0)
        return found
