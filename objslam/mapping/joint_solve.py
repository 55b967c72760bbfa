"""Joint mode: where the rounds of association and solve begin, and which of their results counts."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from objslam.association.nearest_neighbour import associate_by_label
from objslam.core.geometry import inverse
from objslam.core.noise import NOMINAL, NoiseFactors
from objslam.errors import SolveError
from objslam.frontend.turning_clocks import clocks_of_turns
from objslam.frontend.turning_odometry import with_turns_of_tracks
from objslam.mapping.doubted_labels import (
    CLEAR_ODDS,
    doubted_names,
    evidence_against,
    has_labels_of,
    has_several,
    needs_noisy_boxes,
)
from objslam.mapping.fixed.camera_calibration import associate_rows
from objslam.mapping.fixed.fixed_poses import FixedPoses
from objslam.mapping.joint_alternation import JointState
from objslam.mapping.labels import (
    angles_to_objects,
    clock_explains,
    labels_tell,
    may_be_by_label,
    noise_explains,
    shows_second_object,
    warn_of_noise,
)
from objslam.mapping.solution import seen_something

if TYPE_CHECKING:
    from objslam.core.arrays import Floats
    from objslam.frontend.shared_errors import SharedErrors
    from objslam.graph.init_unknown_correspondences import InitialEstimate

_NOISIER = 1.5
"""The factor on the noise of rays or odometry, found by a solve, above which a looser odometry is tried as well.
A larger factor explores fewer logs twice."""
_CLEAR = 0.95
"""The share of agreeing rays above which a log is not explored again, whatever its noise. A larger share explores more logs
twice. In simulation, maps that show objects twice explained at most 0.93 of the rays. A good map can explain as few: the log
of a real robot in a forest is explored twice without need."""
_CLEARLY = 3.0
"""A log is explored again with the shared errors of its odometry that the solve found, if one of them is this number of
standard deviations from what the exploration assumed. A larger number explores fewer logs twice."""
_LOOSE = 3.0
"""The factor on the noise of the odometry in the second exploration, if the solve found only the rays to be noisy. A larger
factor suits worse odometry, and loses more objects of good odometry."""


def solve_joint(state: JointState, start: InitialEstimate | None) -> JointState:
    """Return the state after association and solve of a log. It has an association and an estimate.

    start: a known start. With it, the log is not explored, and labels are not trusted.
    """
    state = _with_noise_of_poses(_with_clocks(state))
    if start is not None or not may_be_by_label(state.settings, state.all_rays):
        return _associated(state, start)
    named, agree = _by_label(state)
    if state.settings.association.method == "by_label" or not doubted_names(named):
        return named if agree else _associated(replace(named, association=None, estimate=None), None)
    # The noise and the shared errors of a map with a bent path would bend the path again. So the search begins without them.
    if not agree:
        return _associated(state, None)
    return _with_several_a_label(state, named)


def _with_several_a_label(state: JointState, named: JointState) -> JointState:
    """Return the state with several objects a label if there is clear evidence for it, else the state `named`, which has one
    object for each label. state: before the solve by labels.

    A short drive may show too little for an exploration, which then finds fewer objects than there are labels, or parts of
    one object. So labels count as names unless the other map has objects for all of them, and is far more likely.
    """
    doubted = doubted_names(named)
    try:
        other = _associated(state.attempt(), None)
        odds = evidence_against(named, other) if has_several(other) else -np.inf
    except SolveError:  # The map by labels is there, whatever is wrong with the other one.
        return replace(named, doubted=doubted)
    if odds > CLEAR_ODDS and has_labels_of(other, named):
        return named.replaced(other)
    unclear = odds > -CLEAR_ODDS or (has_several(other) and needs_noisy_boxes(named, other))
    return replace(named, doubted=doubted) if unclear else named


def _associated(state: JointState, start: InitialEstimate | None) -> JointState:
    """Return the state after association and solve from a known start, or from an exploration of the log."""
    if start is not None or state.keyframes.localized_every:
        found = _improved(_from_start(state, start), JointState.relocalized)
        state = _without_confused_rows(state, found) if start is None else found
    else:
        begin = _with_turns(state)
        solved, first = _explored(begin)
        explored = _from_start(solved, first)
        state = _improved(explored, JointState.relocalized)
        noisier = _with_loose_odometry(explored, begin.theta, first)
        if noisier is not None:
            state = state.better(_improved(_from_start(*_explored(noisier)), JointState.relocalized))
        state = _improved(state, JointState.split)
    assert state.association is not None
    if state.unsettled:
        rounds, changed = state.settings.joint.max_rounds, f"{state.unsettled} of {state.association.count} objects"
        state.ledger.warn(f"the association still changes {changed} after {rounds} rounds (joint.max_rounds)")
    if state.hold:  # The covariances now contain the shared errors, so that more pairs may be one object.
        state = replace(state, hold=False).solve("association", state.association, state.solved_poses).merged()
    return _with_few_rays(state)


def _with_few_rays(state: JointState) -> JointState:
    """Return the state with the objects that can be found from few rays.

    Few rays hardly correct the poses before these objects are known. So the search allows for all the noise that the
    localisation had."""
    from objslam.association.few_rays.additional_objects import add_few_ray_objects
    from objslam.graph.fixed_pose_triangulation import flat_noise

    association, estimate = state.association, state.estimate
    assert association is not None
    assert estimate is not None
    frames, rays, map_T_camera = state.every_frame(estimate.map_T_base)
    sigma, place, scale = flat_noise(rays, frames, state.settings)
    found = add_few_ray_objects(
        rays,
        frames,
        state.cameras,
        state.settings,
        association,
        np.where(estimate.solved[:, None], estimate.positions, np.nan),
        map_T_camera=map_T_camera,
        sigma=sigma,
        position_sigma=place,
        seed=state.settings.seed,
        flat_scale=scale,
    )
    return state if found.count == association.count else state.counted(found).solve("few rays", found, state.solved_poses)


def _with_clocks(state: JointState) -> JointState:
    """Return the state that begins at the clock offsets which the robot's turns show."""
    if state.errors is None or state.theta is not None:
        return state
    theta = clocks_of_turns(state.errors)
    keyframes, rays, _ = state.errors.at(theta)
    return replace(state, theta=theta, keyframes=keyframes, rays=rays)


def _with_turns(state: JointState) -> JointState:
    """Return the state that begins at the error of the odometry's turns which the tracks of boxes show."""
    if state.errors is None:
        return state
    theta = with_turns_of_tracks(state.errors, state.errors.mean if state.theta is None else state.theta)
    keyframes, rays, _ = state.errors.at(theta)
    return replace(state, theta=theta, keyframes=keyframes, rays=rays)


def _with_noise_of_poses(state: JointState) -> JointState:
    """Return the state that begins with the noise of the localisation which the odometry shows."""
    if state.errors is None or "localization" not in state.errors.unknown_noise or state.keyframes.odom_T_base is None:
        return state
    from objslam.graph.calibration.paths_alone import noise_of_paths

    theta = state.errors.mean if state.theta is None else state.theta
    errors = state.errors.with_noise(noise_of_paths(state.errors, theta))
    keyframes, rays, _ = errors.at(theta)
    return replace(state, errors=errors, keyframes=keyframes, rays=rays)


def _from_start(state: JointState, start: InitialEstimate | None) -> JointState:
    """Return the state after rounds from a start, or from the poses of the keyframes."""
    map_T_camera = state.keyframes.map_T_camera if start is None else start.map_T_camera
    guess = None if start is None else (start.association, start.positions)
    return state.alternated(map_T_camera @ inverse(state.keyframes.base_T_camera), guess)


def _without_confused_rows(begin: JointState, state: JointState) -> JointState:
    """Return the state, or one from the association of the fixed mode if the log shows rows of equal things.

    The first association at localised poses has wide gates, because the poses have noise. In such rows, these gates hold the
    rays of neighbours. The later rounds keep these rays, because the poses were bent to fit them. begin: before the first
    association. state: after the rounds that began there.
    """
    if begin.errors is None:
        return state
    measured = begin.frames, begin.all_rays, *seen_something(begin.frames, begin.all_rays)
    found = associate_rows(FixedPoses(*measured, begin.cameras, begin.settings), begin.errors.log, begin.progress)
    if found is None:
        return state
    attempt = begin.attempt().counted(found).solve("association", found)
    assert attempt.estimate is not None
    return state.better(attempt.alternated(attempt.estimate.map_T_base, (found, attempt.estimate.positions)))


def _improved(state: JointState, step: Callable[[JointState], JointState]) -> JointState:
    """Return the state after steps, until the rays are no better explained. step: it then returns the state itself."""
    for _ in range(state.settings.joint.max_rounds):
        found = step(state)
        if found is state:
            break
        state = found
    return state


def _by_label(state: JointState) -> tuple[JointState, bool]:
    """Return the state with one object per label, and whether the rays agree with it. If they disagree at a few labels only,
    the shared errors and the noise of the state are still better than the nominal values."""
    association, errors = associate_by_label(state.rays), state.errors
    solved = state.solve("labels", association)
    assert solved.estimate is not None
    if state.settings.association.method == "by_label":
        return solved, True
    told = labels_tell(association, solved.estimate)
    if (association.object < 0).any():  # Noise or a wrong clock cannot cause a second box of one label.
        return _with_doubles(solved) if told else (solved, False)
    if told:
        return solved, True
    if solved.errors is None or errors is None:
        return solved, False
    noisier = noise_explains(association, solved.estimate, solved.errors, partial(solved.solve_once, association))
    if noisier is not None:
        again = solved.solve("labels", association, noisier.map_T_base @ solved.keyframes.base_T_camera)
        assert again.estimate is not None
        warn_of_noise(solved.errors, noisier, state.ledger)
        # The last solve estimates the noise again, unless the settings fix it, and may reject the rays of an object.
        known = solved.errors.with_unknown_noise().unknown_noise != solved.errors.unknown_noise
        return (again, True) if known or labels_tell(association, again.estimate) else (solved, False)
    begin = clock_explains(association, errors, lambda at: solved.solve_once(association, errors, begin=at))
    if begin is None:
        return solved, False
    return replace(solved, errors=errors, theta=begin).solve("labels", association), True


def _with_doubles(state: JointState) -> tuple[JointState, bool]:
    """Return the state of one object per label with the nearest box of each label and keyframe, and whether the other boxes
    show no second object of any label."""
    assert state.association is not None
    assert state.estimate is not None
    nearest = associate_by_label(state.rays, angles_to_objects(state.rays, state.estimate, state.solved_poses))
    if not np.array_equal(nearest.object, state.association.object):
        state = state.solve("labels", nearest, state.solved_poses)
    assert state.estimate is not None
    solved = state.rays, nearest, state.estimate, state.keyframes, state.solved_poses
    return state, not shows_second_object(*solved, state.settings)


def _explored(state: JointState) -> tuple[JointState, InitialEstimate]:
    """Explore a log without a localisation. Return the state and a first association. If the filter for logs with ranges is
    sure of the association, the state is solved with it and holds the shared errors."""
    from objslam.graph import ekf_exploration
    from objslam.graph.init_unknown_correspondences import initialize_unknown

    exploring = partial(state.progress, "explore")
    start: InitialEstimate | None = None
    if np.isfinite(state.rays.range).any():
        surface = 0.0 if state.errors is None else _surface(state.errors, state.theta)
        start = ekf_exploration.explore(state.keyframes, state.rays, state.settings, exploring, state.errors, surface)
    if start is None or not ekf_exploration.is_sure(start):
        return state, initialize_unknown(state.keyframes, state.rays, state.cameras, state.settings, exploring)
    solved = state.solve("association", start.association)
    assert solved.estimate is not None
    start = replace(start, map_T_camera=solved.solved_poses, positions=solved.estimate.positions)
    return replace(solved, hold=True, association=None), start


def _with_loose_odometry(
    state: JointState, assumed: Floats | None, first: InitialEstimate | None = None
) -> JointState | None:
    """Return an attempt with the noise and the shared errors of the odometry that the last solve suggests.

    None if the noise is about nominal and the shared errors are about those `assumed` (P,) by the first exploration, if the
    settings fix the noise, or if nearly all rays agree. The solve finds them, but the exploration needs them before. A wrong
    map can hide the noise of the odometry in the noise of the rays.

    The filter finds both while it explores (`first`). So noise of the odometry is no reason to explore again if the filter's
    corrections were about as large as it expected, and its shared errors count as assumed.

    The noise is at least nominal. A solve estimates the shared errors and the noise together, so the rest may be small. An
    exploration has the shared errors fixed, and those of a wrong map are wrong by more than their sigma. With half the noise
    it expects known objects within gates that they miss, and maps them again.

    If nearly all rays agree, wrong distances of centres behind surfaces may still have misled the exploration: an object
    that is seen from another side then seems to be another object. If the distances differ by more than those of single
    objects do, the log is explored with them.
    """
    if state.errors is None or "odometry" not in state.errors.unknown_noise:
        return None
    found, values = state.errors.noise, state.theta
    if state.agree.mean() >= _CLEAR:
        start = state.errors.mean if assumed is None else assumed
        if abs(_surface(state.errors, values) - _surface(state.errors, start)) <= state.settings.depth.centre_sigma:
            return None
        of_surface = np.array([name == "surface" for name in state.errors.names])
        found, values = NOMINAL, np.where(of_surface, _surface(state.errors, values), start)
    elif not _trusted_too_much(found, first):
        shared = assumed if first is None or first.shared is None else first.shared
        if found.rays > _NOISIER:
            found, values = NoiseFactors(along=_LOOSE, across=_LOOSE, turning=_LOOSE), assumed
        elif not _drives_otherwise(state, shared):
            return None
    errors = state.errors.with_noise(_at_least_nominal(found))
    keyframes, rays, _ = errors.at(errors.mean if values is None else values)
    unknown = replace(state.attempt(), association=None, estimate=None, hold=False, theta=values)
    return replace(unknown, errors=errors, keyframes=keyframes, rays=rays)


def _trusted_too_much(found: NoiseFactors, first: InitialEstimate | None) -> bool:
    """Return whether an exploration `first` trusted the odometry clearly more than the noise `found` by the solve allows.

    The filter adapts the noise of the odometry to its own corrections. Their mean square, relative to its expectation, is 1
    at the right noise.
    """
    if first is not None and np.isfinite(first.surprise):
        return first.surprise > _NOISIER**2
    return max(found.along, found.turning) > _NOISIER


def _at_least_nominal(noise: NoiseFactors) -> NoiseFactors:
    """Return the noise of an exploration: no noise of rays or odometry below that of the settings, and no shrinkage."""
    odometry = {name: max(getattr(noise, name), 1.0) for name in ("along", "across", "turning")}
    return replace(noise, rays=max(noise.rays, 1.0), shrinkage=0.0, **odometry)


def _surface(errors: SharedErrors, values: Floats | None) -> float:
    """Return the shared error `surface` among values (P,), 0 if it is not estimated."""
    return 0.0 if values is None else float(values[[name == "surface" for name in errors.names]].sum())


def _drives_otherwise(state: JointState, assumed: Floats | None) -> bool:
    """Return whether the solve found that the robot turns or drives clearly less or more than the exploration assumed.

    An exploration with this error may take neighbours of one label for one object. The map then bends between them.
    """
    assert state.errors is not None
    assert state.estimate is not None
    found = state.estimate.calibration
    if found is None:
        return False
    of_odometry = np.array([name.startswith("odometry.") for name in found.names])
    off = np.abs(found.values - (state.errors.mean if assumed is None else assumed)) > _CLEARLY * found.sigma
    return bool((off & of_odometry).any())
