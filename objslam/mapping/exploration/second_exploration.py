"""Decide whether a log is explored a second time, and with which odometry."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from objslam.core.noise import NOMINAL, NoiseFactors
from objslam.mapping.solution import rays_moved

if TYPE_CHECKING:
    from objslam.core.arrays import Floats
    from objslam.core.types import Association
    from objslam.frontend.shared_errors import SharedErrors
    from objslam.mapping.joint.joint_alternation import JointState

_NOISIER = 1.5
"""The factor on the noise of rays or odometry above which a log is explored again, with a looser odometry. With a larger
factor, fewer logs are explored twice."""
_CLEAR = 0.95
"""The share of agreeing rays from which much noise is no reason to explore a log again. The exception is a log that the
filter for ranges is sure of. With a larger share, more logs are explored twice. In simulation, at most 0.93 of the rays
agreed with maps that show objects twice. With ranges, up to 0.96 agreed. Sometimes no more rays agree with a good map."""
_SAME = 0.01
"""The largest share of rays that may belong to other objects in a second exploration, so that it counts as the same map and
is not continued. Two explorations of one drive always assign a few rays between neighbours in different ways. With a larger
share, more second explorations are not continued."""
_CLEARLY = 3.0
"""The number of standard deviations between the estimated and the assumed value of a shared error of the odometry, above
which the log is explored again. The solve estimates the value, and the exploration assumed one. With a larger number, fewer
logs are explored twice."""
_LOOSE = 3.0
"""The factor on the noise of the odometry in the second exploration, if the solve found only the rays to be noisy. A larger
factor suits worse odometry. With good odometry, it loses more objects."""


def with_loose_odometry(state: JointState, assumed: Floats | None, sure: bool = False) -> JointState | None:
    """Return the state for a second exploration of the log. Return None if there is no reason to explore again.

    An exploration needs the noise and the shared errors of the odometry, but only a solve shows them. So the first
    exploration assumes nominal noise and the errors `assumed`. The second exploration uses the noise and the errors that the
    last solve found. There is no reason for it in three cases. The found values are about the assumed ones. The settings fix
    the noise. Or nearly all rays agree with the map.

    If the solve found only the rays to be noisy, the odometry gets more noise (`_LOOSE`), because a wrong map can hide the
    noise of the odometry in the noise of the rays.

    The noise of the second exploration is never below the settings. The solve may find less noise, because it also estimates
    the shared errors. The exploration cannot change these errors. After a wrong map, they are wrong by more than their
    sigma. With too little noise, known objects would then be outside their gates, and the exploration would map them twice.

    There are two exceptions if nearly all rays agree. First, the shared error `surface` may be wrong. It is the error of the
    distance from surfaces to the centres behind them. With a wrong value, an object seen from another side seems to be
    another object. If the solve changed the value by more than single objects differ, the second exploration uses the new
    value. Second, with `sure`, noisy odometry is reason enough.

    assumed: (P,) the shared errors in the first exploration, None for the means of their priors. sure: whether the filter
    for logs with ranges was sure of the first exploration. This filter takes little time to explore a log again, and rays
    can also agree with a map that shows objects twice.
    """
    if state.errors is None or "odometry" not in state.errors.unknown_noise:
        return None
    found, values = state.errors.noise, state.theta
    noisier = max(found.along, found.turning) > _NOISIER
    if state.agree.mean() >= _CLEAR and not (sure and noisier):
        start = state.errors.mean if assumed is None else assumed
        if abs(surface_of(state.errors, values) - surface_of(state.errors, start)) <= state.settings.depth.centre_sigma:
            return None
        of_surface = np.array([name == "surface" for name in state.errors.names])
        found, values = NOMINAL, np.where(of_surface, surface_of(state.errors, values), start)
    elif not noisier:
        if found.rays > _NOISIER:
            found, values = NoiseFactors(along=_LOOSE, across=_LOOSE, turning=_LOOSE), assumed
        elif not _drives_otherwise(state, assumed):
            return None
    errors = state.errors.with_noise(_at_least_nominal(found))
    keyframes, rays, _ = errors.at(errors.mean if values is None else values)
    unknown = replace(state.attempt(), association=None, estimate=None, hold=False, theta=values)
    return replace(unknown, errors=errors, keyframes=keyframes, rays=rays)


def _at_least_nominal(noise: NoiseFactors) -> NoiseFactors:
    """Return the noise for an exploration. The noise of rays and odometry is at least that of the settings, and there is no
    shrinkage."""
    odometry = {name: max(getattr(noise, name), 1.0) for name in ("along", "across", "turning")}
    return replace(noise, rays=max(noise.rays, 1.0), shrinkage=0.0, **odometry)


def surface_of(errors: SharedErrors, values: Floats | None) -> float:
    """Return the shared error `surface` among values (P,) of the shared errors. Return 0 if it is not estimated."""
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


def finds_same_objects(state: JointState, start: Association) -> bool:
    """Return whether the association `start` has the same objects as `state`. If so, it would lead to the same map.

    Rays that have no object in `start` or in `state` do not count, because later rounds assign them again.
    """
    assert state.association is not None
    before, after = state.association.object, start.object
    both = (before >= 0) & (after >= 0)
    return rays_moved(before[both], after[both]) <= _SAME * len(before)
