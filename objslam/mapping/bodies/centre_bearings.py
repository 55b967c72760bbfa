"""Bearings and ranges to the centres of bodies, for the joint mode.

The centre of a box is not the image of the centre of the object. For large objects nearby, this error bends the estimated
path. A range ends on the surface of the object. A body that was seen from many sides shows how far its centre is behind its
surface.
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from objslam.core.arrays import Bools, Floats
from objslam.core.statistics import grouped_median
from objslam.core.types import Association, Keyframes, Rays
from objslam.mapping.bodies.fitting import with_bodies
from objslam.mapping.solution import CentreShift, Solution, with_noise_of, without_errors

if TYPE_CHECKING:
    from objslam.core.estimate import Estimate
    from objslam.mapping.joint.joint_alternation import JointState

_KEPT = 0.5
"""The least parallax of an object that stays in the graph, as a share of joint.min_parallax_deg. With a larger share, more
objects are lost from the graph. The bearings of a lost object stay as they were."""
_WORTH = 0.1
"""Poses are solved again if the median shift of an object's bearings exceeds this number of standard deviations of one
bearing. A shift repeats in all bearings of the object. So a shift of 0.1 equals the noise of the mean of 100 bearings. A
larger value solves fewer logs again."""
_WORTH_OF_RANGE = 0.25
"""Poses are solved again if the median change of an object's ranges exceeds this share of the bias that they may share. A
larger value solves fewer logs again."""


def solve_to_centres(state: JointState, association: Association, estimate: Estimate) -> tuple[Estimate, CentreShift | None]:
    """Return the estimate from bearings and ranges to the centres of bodies, and the shift of the rays.

    A ray that the solve rejects is not shifted. If an object would be lost, its bearings stay at the centres of its boxes.
    If an object would still be lost, or if no body shifts its bearings or ranges enough, the estimate does not change and
    the second value is None. The bodies are not fitted again at the new poses. In 24 simulated drives between large objects,
    this would change the path by 1 mm, and the objects by less than their noise.
    """
    if not state.settings.bodies.use:
        return estimate, None
    # With bearings to the centre of its body, an object of the graph may have a little less parallax.
    joint = state.settings.joint
    joint = joint.model_copy(update={"min_parallax_deg": _KEPT * joint.min_parallax_deg})
    settings = state.settings.model_copy(update={"joint": joint})
    keyframes, rays = state.keyframes, state.rays
    if state.errors is not None:
        keyframes, rays = without_errors(state.errors, estimate)
    shift = with_bodies(Solution(keyframes, rays, association, estimate, ()), state.cameras, state.settings).to_centre
    if shift is None:
        return estimate, None
    # A rejected ray shows another thing. A shift would turn the ray to this body, and the ray would then wrongly agree.
    shift = shift.only(estimate.weight > 0)
    worth = worth_turning(shift, rays.sigma, association) | worth_lengthening(shift, rays, association)
    if not worth.any():
        return estimate, None
    held = association.object >= 0
    state = replace(state, settings=settings)
    solved = _solve(state, keyframes, rays, association, estimate, shift)
    lost = estimate.solved & ~solved.solved
    if lost.any():
        shift = shift.only(~(held & lost[association.object]))
        solved = _solve(state, keyframes, rays, association, estimate, shift)
    if (estimate.solved & ~solved.solved).any():
        return estimate, None
    if state.trace is not None:
        state.trace.end_round("bodies", association, solved)
    # A rejected ray may show a second thing, so it keeps its direction. Rays that were turned to the centre of this body
    # would no longer meet at the second thing.
    return solved, shift.only(solved.weight > 0)


def _solve(
    state: JointState, keyframes: Keyframes, rays: Rays, association: Association, estimate: Estimate, shift: CentreShift
) -> Estimate:
    """Solve poses and objects once more, from the estimate, with the measured rays turned by `shift`.

    keyframes, rays: from the state, with the shared errors of the estimate removed.
    """
    from objslam.graph import batch_solver

    measured = state.rays if state.errors is None else state.errors.rays
    turned, errors = shift.apply(measured), None
    if shift.ranges is not None:
        turned = shift.ranges.apply(turned, state.settings)
    if state.errors is not None:
        errors = replace(with_noise_of(state.errors, estimate), rays=turned, settings=state.settings)
    return batch_solver.solve_joint(
        keyframes,
        turned if errors is None else rays,
        association,
        state.settings,
        state.ledger,
        partial(state.progress, "bodies"),
        estimate.map_T_base @ keyframes.base_T_camera,
        state.trace,
        errors,
        None if estimate.calibration is None else estimate.calibration.values,
        places=estimate.positions,
    )


def worth_turning(shift: CentreShift, sigma: Floats, association: Association) -> Bools:
    """Return for which objects (N,) the bearings to the centre of the body are worth another solve (`_WORTH`).

    sigma: (R,) rad, the noise of the rays.
    """
    held = association.object >= 0
    deviation = (np.linalg.norm(shift.direction, axis=1) / sigma)[held]
    return np.asarray(grouped_median(deviation, association.object[held], association.count) > _WORTH)


def worth_lengthening(shift: CentreShift, rays: Rays, association: Association) -> Bools:
    """Return for which objects (N,) the ranges to the centre of the body are worth another solve (`_WORTH_OF_RANGE`)."""
    held = association.object >= 0
    if shift.ranges is None or not shift.ranges.told.any():
        return np.zeros(association.count, dtype=bool)
    told = held & shift.ranges.told
    change = np.abs(shift.ranges.factor - 1)[told] * rays.range[told] / np.maximum(rays.range_bias[told], 1e-9)
    return np.asarray(grouped_median(change, association.object[told], association.count) > _WORTH_OF_RANGE)
