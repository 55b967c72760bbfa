"""Joint mode: choose where the rounds of association and solve begin, and which of their results counts."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from objslam.errors import SolveError
from objslam.frontend.turning_clocks import clocks_of_turns
from objslam.mapping.exploration.second_exploration import finds_same_objects
from objslam.mapping.fixed.camera_calibration import associate_at_poses
from objslam.mapping.fixed.fixed_poses import FixedPoses
from objslam.mapping.joint.by_label import Named, at_other_labels, by_label
from objslam.mapping.joint.diverging_rays import labels_diverge
from objslam.mapping.joint.doubted_labels import (
    CLEAR_ODDS,
    doubted_names,
    evidence_against,
    has_labels_of,
    has_several,
    needs_noisy_boxes,
)
from objslam.mapping.joint.held_errors import Solved, with_gross_errors
from objslam.mapping.joint.joint_alternation import JointState
from objslam.mapping.joint.labels import may_be_by_label
from objslam.mapping.joint.relocalization import relocalized
from objslam.mapping.moves.moving_things import associated_at_rest, without_moving_things
from objslam.mapping.moves.phantoms import begins_with_lasting_errors, has_lasting_errors, without_phantoms
from objslam.mapping.several_starts import from_several_starts, from_start, improved
from objslam.mapping.solution import seen_something

if TYPE_CHECKING:
    from objslam.graph.init_unknown_correspondences import InitialEstimate


def solve_joint(begin: JointState, start: InitialEstimate | None) -> JointState:
    """Return the state after association and solve of a log. The state has an association and an estimate.

    A held error is one that the solve does not estimate. If the map shows that a held error is gross, the log is solved once
    more, and this error is estimated as a shared error. start: a known start. With a start, labels are not taken for names.
    """
    state = _begun(begin)
    if start is not None or not _may_be_names(state):
        return _associated_again(begin, state, start)
    before = state.ledger.copy()
    named = by_label(state)
    if not named.agree:  # The warnings of a solve do not matter if its map is not used.
        state.ledger.restore(before)
    wider, named = _named_with_gross_errors(begin, named)
    if wider is not None:
        other = _begun(wider.attempt())
        again = by_label(other)
        if again.agree or again.others is not None or again.doubtful is not None:
            begin, state, named = wider, state.replaced(other), replace(again, state=state.replaced(again.state))
    if named.agree:
        doubted = state.settings.association.method != "by_label" and bool(doubted_names(named.state))
        return _with_several_a_label(state, named.state) if doubted else named.state
    if (found := _of_agreeing_labels(state, named)) is not None:
        return found
    # The noise and the shared errors of a wrong map would bend the path again. So the search begins without them.
    return _associated_again(begin, state, None, named.state)


def solve_names(begin: JointState) -> JointState | None:
    """Return the state after a solve in which labels are names: all labels, or those that agree with each other. Return None
    if labels do not show the path.

    Nothing is explored, so this takes less time than `solve_joint`. The state also has the objects of the other labels, if
    they are at rest.
    """
    state = _begun(begin)
    if not _may_be_names(state):
        return None
    named = by_label(state)
    if named.agree:
        return named.state
    found = None if named.others is None else at_other_labels(state, named.others)
    return None if found is None else without_moving_things(associated_at_rest(found))


def _may_be_names(state: JointState) -> bool:
    """Return whether to try one object for each label (`may_be_by_label`). With the method `auto`, this needs labels whose
    rays mostly do not diverge."""
    known = state.settings.association.method != "auto"
    return may_be_by_label(state.settings, state.all_rays) and (known or not labels_diverge(state.keyframes, state.rays))


def _associated_again(
    begin: JointState, state: JointState, start: InitialEstimate | None, named: JointState | None = None
) -> JointState:
    """Return the state after association and solve. If its map shows that a held error is gross, both are repeated with this
    error estimated. named: as in `from_several_starts`."""
    before = state.ledger.copy()
    found = _associated(state, start, named)
    if found.effort.interrupted:
        return found
    wider, found = _with_gross_errors(begin, found)
    if wider is None:
        return found
    state.ledger.restore(before)
    return _associated(_begun(wider), start)


def _begun(state: JointState) -> JointState:
    """Return the state with what a log shows before its first solve: clock offsets, and the noise of localised poses."""
    return _with_noise_of_poses(_with_clocks(state))


def _named_with_gross_errors(begin: JointState, named: Named) -> tuple[JointState | None, Named]:
    """Return what `_with_gross_errors` returns for the surest map of the labels. The second value has this map in its place
    among `named`."""
    if named.others is not None:
        wider, solved = _with_gross_errors(begin, named.others)
        return wider, replace(named, others=solved)
    if named.doubtful is not None:
        wider, solved = _with_gross_errors(begin, named.doubtful)
        return wider, replace(named, doubtful=solved)
    wider, solved = _with_gross_errors(begin, named.state)
    return wider, replace(named, state=solved)


def _with_gross_errors(begin: JointState, found: JointState) -> tuple[JointState | None, JointState]:
    """Return the start of a solve that also estimates the gross held errors, and return `found`. The start is None if the
    map of `found` shows no gross error. The estimate of the returned `found` may now contain the effect of the held
    errors."""
    if begin.errors is None or found.errors is None or found.association is None or found.estimate is None:
        return None, found
    errors = found.errors.with_noise(begin.errors.noise)
    wider, estimate = with_gross_errors(errors, Solved(found.association, found.estimate, found.keyframes))
    other = None if wider is None else replace(begin, errors=wider, settings=wider.settings)
    return other, replace(found, estimate=estimate)


def _of_agreeing_labels(state: JointState, named: Named) -> JointState | None:
    """Return the state in which the labels that agree are names. It also has the objects of the other labels. Return None if
    no labels show the path. state: before the solve by labels.

    Doubted labels among those that agree are names too, unless there is clear evidence against it.
    """
    aside = state if named.doubtful is None else state.attempt()
    found = None if named.others is None else at_other_labels(aside, named.others)
    found = None if found is None else _settled(found)
    kept = None if named.doubtful is None else at_other_labels(state, named.doubtful)
    return found if kept is None else _with_several_a_label(state, _settled(kept), found)


def _with_several_a_label(state: JointState, named: JointState, other: JointState | None = None) -> JointState:
    """Return the state with several objects per label if there is clear evidence for it. Otherwise return the state `named`,
    which has one object for each label that agrees. state: before the solve by labels. other: the state with several objects
    per label. If it is None, it is solved here.

    A short drive may show too little for an exploration. The exploration then finds fewer objects than there are labels, or
    splits one object into parts. So labels count as names unless the other map has objects for all labels, and is far more
    likely.
    """
    doubted = doubted_names(named)
    try:
        other = _associated(state.attempt(), None, named) if other is None else other
        several = has_several(other, named)
        odds = evidence_against(named, other) if several else -np.inf
    except SolveError:  # The map by labels is there, whatever is wrong with the other one.
        return replace(named, doubted=doubted)
    if odds > CLEAR_ODDS and has_labels_of(other, named):
        return named.replaced(other)
    unclear = odds > -CLEAR_ODDS or (several and needs_noisy_boxes(named, other))
    return replace(named, doubted=doubted) if unclear else named


def _associated(state: JointState, start: InitialEstimate | None, named: JointState | None = None) -> JointState:
    """Return the state after association and solve. start: a known start. If its map is unclear and the log has no
    localisation, other starts are tried. named: as in `from_several_starts`."""
    if state.keyframes.localized_every:
        doubtful = begins_with_lasting_errors(state)
        found = improved(from_start(state, start), relocalized)
        state = _or_as_in_fixed_mode(state, found) if start is None else found
        if doubtful or has_lasting_errors(state):
            state = _anew(state.split())
            if state.keyframes.odom_T_base is not None:  # It gives the motions in a map without phantoms.
                state = without_phantoms(state)
    else:
        state = from_several_starts(state, start, named)
        state = improved(state, JointState.split)
    return _settled(state)


def _settled(state: JointState) -> JointState:
    """Return the state after the steps that follow the last round. These steps solve all shared errors, add objects from few
    rays, and drop objects of things that move."""
    assert state.association is not None
    if state.unsettled:
        rounds, changed = state.settings.joint.max_rounds, f"{state.unsettled} of {state.association.count} objects"
        state.ledger.warn(f"the association still changes {changed} after {rounds} rounds (joint.max_rounds)")
    if state.hold:  # The covariances now contain the shared errors, so more pairs of objects may be one object.
        state = replace(state, hold=False).solve("association", state.association, state.solved_poses).merged()
    # The search for objects from few rays leaves out the rays of dropped objects.
    return without_moving_things(_with_few_rays(associated_at_rest(state)))


def _with_few_rays(state: JointState) -> JointState:
    """Return the state with the objects that can be found from few rays.

    The rays of such objects have hardly corrected the poses yet. So the search allows for all the noise that the
    localisation had before the solve."""
    from objslam.association.few_rays.additional_objects import add_few_ray_objects
    from objslam.association.observations import PosedRays
    from objslam.graph.fixed_pose_triangulation import flat_noise

    association, estimate = state.association, state.estimate
    assert association is not None
    assert estimate is not None
    frames, rays, map_T_camera = state.every_frame(estimate.map_T_base)
    sigma, place, scale = flat_noise(rays, frames, state.settings)
    found = add_few_ray_objects(
        PosedRays(rays, frames, state.cameras, map_T_camera, sigma, place, scale),
        state.settings,
        association,
        np.where(estimate.solved[:, None], estimate.positions, np.nan),
        seed=state.settings.seed,
    )
    return state if found.count == association.count else state.counted(found).solve("few rays", found, state.solved_poses)


def _with_clocks(state: JointState) -> JointState:
    """Return the state that begins at the clock offsets which the robot's turns show."""
    if state.errors is None or state.theta is not None:
        return state
    theta = clocks_of_turns(state.errors)
    keyframes, rays, _ = state.errors.at(theta)
    return replace(state, theta=theta, keyframes=keyframes, rays=rays)


def _with_noise_of_poses(state: JointState) -> JointState:
    """Return the state that begins with the noise of the localisation which the odometry shows."""
    if state.errors is None or "localization" not in state.errors.unknown_noise or state.keyframes.odom_T_base is None:
        return state
    from objslam.graph.calibration.localization_noise import noise_of_paths

    theta = state.errors.mean if state.theta is None else state.theta
    errors = state.errors.with_noise(noise_of_paths(state.errors, theta))
    keyframes, rays, _ = errors.at(theta)
    return replace(state, errors=errors, keyframes=keyframes, rays=rays)


def _or_as_in_fixed_mode(begin: JointState, state: JointState) -> JointState:
    """Return the better of two states: the given one, and one that begins with the association of the fixed mode.

    The first association at localised poses allows for the noise of the localisation, but not for the errors of cameras. The
    gates of this association may be too wide for rows of equal things. They may be too narrow for a camera that is mounted
    askew, or for a localisation that errs for seconds. Then an object has rays of two things. The later rounds keep these
    rays, because the poses were bent to fit them. The fixed mode calibrates the cameras, and finds the noise of the poses in
    the boxes of each frame. If there is an earlier map at the given poses, its association is used. begin: before the first
    association. state: after the rounds that began there.
    """
    if begin.errors is None:
        return state
    found = begin.at_poses
    if found is None:
        measured = begin.frames, begin.all_rays, *seen_something(begin.frames, begin.all_rays)
        found = associate_at_poses(FixedPoses(*measured, begin.cameras, begin.settings), begin.errors.log, begin.progress)
    if found is None or finds_same_objects(state, found):
        return state
    attempt = begin.attempt().counted(found).solve("association", found)
    assert attempt.estimate is not None
    return state.better(attempt.alternated(attempt.estimate.map_T_base, (found, attempt.estimate.positions)))


def _anew(state: JointState) -> JointState:
    """Return the better of two states: the given one, and one after rounds that begin at its solved poses without an
    association. The given state is better if it explains the log better.

    The first association was at poses that err. The rounds keep the objects of this association while these have enough
    rays."""
    assert state.estimate is not None
    attempt = replace(state.attempt(), association=None)
    return state.better(attempt.alternated(state.estimate.map_T_base, None))
