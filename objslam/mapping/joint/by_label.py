"""Solve a log with one object for each label, or with one for each label that the rays agree with."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from objslam.association.nearest_neighbour import associate_by_label
from objslam.core.types import Association
from objslam.errors import SolveError
from objslam.mapping.joint.doubted_labels import doubted_names, unchecked_labels
from objslam.mapping.joint.labels import (
    angles_to_objects,
    clock_explains,
    labels_tell,
    noise_explains,
    scatter_alone,
    shows_second_object,
    warn_of_noise,
)

if TYPE_CHECKING:
    from objslam.mapping.joint.joint_alternation import JointState


def by_label(state: JointState) -> tuple[JointState, bool]:
    """Return the state with one object per label, and whether the rays agree with it. If they disagree at a few labels only,
    the shared errors and the noise of the state are still better than the nominal values."""
    named, agree = _solved_by_label(state)
    return named, agree and (state.settings.association.method == "by_label" or not scatter_alone(named).any())


def _solved_by_label(state: JointState) -> tuple[JointState, bool]:
    """Return the state with one object per label, and whether hardly a ray is rejected."""
    association, errors = associate_by_label(state.rays), state.errors
    solved = state.solve("labels", association)
    assert solved.estimate is not None
    if state.settings.association.method == "by_label":
        return solved, True
    told = labels_tell(association, solved.estimate)
    if (association.object < 0).any():  # A frame has two boxes of a label. No noise causes that.
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
    """Return the state with one object per label, from the nearest box of each label in each keyframe.

    Also return whether the other boxes show no second object of any label.
    """
    assert state.association is not None
    assert state.estimate is not None
    nearest = associate_by_label(state.rays, angles_to_objects(state.rays, state.estimate, state.solved_poses))
    if not np.array_equal(nearest.object, state.association.object):
        state = state.solve("labels", nearest, state.solved_poses)
    assert state.estimate is not None
    solved = state.rays, nearest, state.estimate, state.keyframes, state.solved_poses
    return state, not shows_second_object(*solved, state.settings)


def at_other_labels(state: JointState, named: JointState) -> JointState | None:
    """Return the state after rounds at the path that all labels show but those that scatter alone. None if this path is not
    sure: too few other labels check it (`unchecked_labels`), their rays do not agree either, or they are doubted.

    At this path, the rounds find the objects of the labels that scatter, if they have any. So the log need not be explored,
    which takes longer. state: before the solve by labels. named: after it.
    """
    assert named.association is not None
    scatter = scatter_alone(named)
    of_one = named.association.label[scatter]
    as_one = replace(named.rays, label=np.where(np.isin(named.rays.label, of_one), of_one[0], named.rays.label))
    if not named.keyframes.localized_every and of_one[0] in unchecked_labels(as_one, named.keyframes):
        return None
    number = np.append(np.where(scatter, -1, np.cumsum(~scatter) - 1), -1)
    others = Association(number[named.association.object], named.association.label[~scatter])
    try:
        solved = state.attempt().solve("labels", others)
        assert solved.estimate is not None
        if not labels_tell(others, solved.estimate) or scatter_alone(solved).any() or doubted_names(solved):
            return None
        return state.replaced(solved.alternated(solved.estimate.map_T_base, (others, solved.estimate.positions)))
    except SolveError:
        return None
