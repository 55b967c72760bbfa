"""Whether a log is explored a second time, and with which odometry."""

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
"""A looser odometry is tried as well if a solve finds more than this factor on the noise of rays or odometry. A larger
factor explores fewer logs twice."""
_CLEAR = 0.95
"""If at least this share of the rays agrees, much noise is no reason to explore a log again. The exception is a log that the
filter for ranges is sure of. A larger share explores more logs twice. In simulation, maps that show objects twice explained
at most 0.93 of the rays, but up to 0.96 with ranges. A good map sometimes explains no more."""
_SAME = 0.01
"""If a second exploration gives at most this share of the rays to other objects than the map does, it is not continued. Two
explorations of one drive always assign a few rays between neighbours in different ways. With a larger share, more second
explorations end there."""
_CLEARLY = 3.0
"""A solve estimates the shared errors of the odometry. If one of them is more than this number of standard deviations from
the value that the exploration assumed, the log is explored again. A larger number explores fewer logs twice."""
_LOOSE = 3.0
"""The factor on the noise of the odometry in the second exploration, if the solve found only the rays to be noisy. A larger
factor suits worse odometry, and loses more objects of good odometry."""


def with_loose_odometry(state: JointState, assumed: Floats | None, sure: bool = False) -> JointState | None:
    """Return the state for a second exploration of the log, None if there is no reason for one.

    An exploration needs the noise and the shared errors of the odometry, but only a solve shows them. So the first
    exploration assumes nominal noise and the values `assumed`. The last solve has found other values, and the second
    exploration uses these. There is no reason for it in three cases. The found values are about the assumed ones. The
    settings fix the noise. Or nearly all rays agree with the map.

    If the solve found only the rays to be noisy, the odometry gets more noise (`_LOOSE`), because a wrong map can hide the
    noise of the odometry in the noise of the rays.

    The noise of the second exploration is never below the settings. The solve may find less noise, because it estimates the
    shared errors too. The exploration does not change them, and after a wrong map they are wrong by more than their sigma.
    With too little noise, known objects would be outside their gates, and the exploration would map them twice.

    There are two exceptions if nearly all rays agree. First, the shared error `surface` may be wrong. It is the error of the
    distance from surfaces to the centres behind them. With a wrong value, an object seen from another side seems to be
    another object. If the solve changed the value by more than single objects differ, the second exploration uses the new
    value. Second, with `sure`, noisy odometry is reason enough.

    assumed: (P,) the shared errors in the first exploration, None for the means of their priors. sure: whether the filter
    for logs with ranges was sure of the first exploration. It explores a log again in little time, and rays can also agree
    with a map that shows objects twice.
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
    """Return the noise of an exploration: no noise of rays or odometry below the settings, and no shrinkage."""
    odometry = {name: max(getattr(noise, name), 1.0) for name in ("along", "across", "turning")}
    return replace(noise, rays=max(noise.rays, 1.0), shrinkage=0.0, **odometry)


def surface_of(errors: SharedErrors, values: Floats | None) -> float:
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


def finds_same_objects(state: JointState, start: Association) -> bool:
    """Return whether the association `start` has the same objects as `state`. Then it would lead to the same map.

    Rays that have no object in `start` or in `state` do not count, because later rounds assign them again.
    """
    assert state.association is not None
    before, after = state.association.object, start.object
    both = (before >= 0) & (after >= 0)
    return rays_moved(before[both], after[both]) <= _SAME * len(before)
