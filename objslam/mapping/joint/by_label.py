"""Solve a log with one object for each label, or with one for each label that the rays agree with."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from objslam.association.nearest_neighbour import associate_by_label
from objslam.core.trajectory import correct_poses
from objslam.core.types import Association
from objslam.errors import SolveError
from objslam.mapping.joint.doubted_labels import doubted_labels, unchecked_labels
from objslam.mapping.joint.labels import (
    MANY,
    OTHERS,
    angles_to_objects,
    clock_explains,
    known_names,
    labels_tell,
    noise_explains,
    rays_beyond,
    rejected,
    scatter_alone,
    shows_second_object,
    warn_of_noise,
)
from objslam.mapping.solution import seen_something

if TYPE_CHECKING:
    from objslam.core.arrays import Floats, Ints
    from objslam.frontend.shared_errors import SharedErrors
    from objslam.mapping.joint.joint_alternation import JointState

_FAILURES = 2
"""The number of consecutive labels that do not agree, after which no more labels are tried. Each try takes a solve, and
later labels fit worse. With a larger number, fewer labels are left out by mistake."""


@dataclass(frozen=True)
class Named:
    """A map with one object for each label.

    state: the solved map. agree: whether the rays agree with this map. others: the map without the labels that scatter and
    without doubted labels. It is None if there is no such map, or if it is not sure. doubtful: the map without the labels
    that scatter, but with the doubted labels, which may name several objects. It is None if no label is doubted.
    """

    state: JointState
    agree: bool
    others: JointState | None = None
    doubtful: JointState | None = None


def by_label(state: JointState) -> Named:
    """Return the map with one object per label, or with one for each label that the rays agree with."""
    association = associate_by_label(state.rays)
    solved = state.solve("labels", association)
    assert solved.estimate is not None
    if state.settings.association.method == "by_label":
        return Named(solved, True)
    told = labels_tell(association, solved.estimate)
    if told and not scatter_alone(solved).any():
        # No noise causes two boxes of a label in one frame.
        return Named(*_with_doubles(solved)) if (association.object < 0).any() else Named(solved, True)
    # If the settings have too little noise, true rays are rejected. So more noise is tried before labels are left out.
    if not told and not (association.object < 0).any() and _has_fixed_noise(solved):
        found = Named(*_with_other_start(state, solved))
        return found if found.agree else Named(found.state, False, *_of_labels_that_agree(state, solved))
    others, doubtful = _of_labels_that_agree(state, solved)
    if others is not None or doubtful is not None:
        return Named(solved, False, others, doubtful)
    if told or (association.object < 0).any():
        return Named(solved, False)
    return Named(*_with_other_start(state, solved))


def at_other_labels(state: JointState, others: JointState) -> JointState | None:
    """Return the state after rounds that begin at the path which the agreeing labels show. Return None if no solve is
    possible.

    At this path, the rounds find the objects of the labels that scatter, if there are such objects. So no exploration is
    needed, which would take longer. The labels that agree stay names, unless their boxes show a second object. The noise is
    not estimated again, because with more noise the path would bend to things that move. state: before the solve by labels.
    others: the map of the labels that agree.
    """
    assert others.association is not None
    assert others.estimate is not None
    errors = None if others.errors is None else _with_known_noise(others.errors)
    known = replace(others, errors=errors, names=known_names(others))
    try:
        return state.replaced(known.alternated(others.estimate.map_T_base, (others.association, others.estimate.positions)))
    except SolveError:
        return None


def _with_known_noise(errors: SharedErrors) -> SharedErrors:
    """Return the same shared errors, with settings in which all noise is known."""
    known = dict.fromkeys(("rays", "ranges", "odometry", "localization"), False)
    noise = errors.settings.noise.model_copy(update=known)
    return replace(errors, settings=errors.settings.model_copy(update={"noise": noise}))


def _with_other_start(state: JointState, solved: JointState) -> tuple[JointState, bool]:
    """Return the state after a solve at other noise or another clock at which labels are names. Also return whether there is
    such noise or such a clock.

    state: before the solve by labels. solved: after this solve, which rejected many rays.
    """
    association, errors = solved.association, state.errors
    assert association is not None
    assert solved.estimate is not None
    if solved.errors is None or errors is None:
        return solved, False
    noisier = noise_explains(association, solved.estimate, solved.errors, partial(solved.solve_once, association))
    if noisier is not None:
        again = solved.solve("labels", association, noisier.map_T_base @ solved.keyframes.base_T_camera)
        assert again.estimate is not None
        warn_of_noise(solved.errors, noisier, state.ledger)
        # The last solve estimates the noise again, unless the settings fix it, and may reject the rays of an object.
        if not _has_fixed_noise(solved) and not labels_tell(association, again.estimate):
            return solved, False
    else:
        begin = clock_explains(association, errors, lambda at: solved.solve_once(association, errors, begin=at))
        if begin is None:
            return solved, False
        again = replace(solved, errors=errors, theta=begin).solve("labels", association)
    return again, not scatter_alone(again).any()


def _has_fixed_noise(state: JointState) -> bool:
    """Return whether the settings fix noise that a solve could estimate."""
    return state.errors is not None and state.errors.with_unknown_noise().unknown_noise != state.errors.unknown_noise


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


def _of_labels_that_agree(state: JointState, named: JointState) -> tuple[JointState | None, JointState | None]:
    """Return two maps of the labels that agree with each other: one without doubted labels, and one with them.

    Rays of a thing that moves bend the path, and then rays of other labels are rejected as well. Without the labels that
    scatter, the path changes. Other labels may scatter at the new path, and labels that scattered may agree. So these are
    tried once more, one after another. The label that fits best comes first, because each label that agrees improves the
    path. At the end, doubted labels are left out as well. The first map is None if the remaining labels do not show the path
    (`_show_path`). The second map has the labels before any was left out because of a doubt. It is None if there was no
    doubt. state: before the solve by labels. named: after it.
    """
    solved, best, doubtful = named, None, None
    tried, failed = np.zeros(0, dtype=np.int64), 0
    while True:
        assert solved.association is not None
        assert solved.estimate is not None
        scatter = rejected(solved.association, solved.estimate) | scatter_alone(solved)
        labels = solved.association.label[~scatter]
        if scatter.any():
            failed += 1
        elif solved is named:
            return None, None
        else:
            best, failed = solved, 0
        if best is not None:
            assert best.association is not None
            more = np.setdiff1d(_by_fit(best), np.union1d(tried, best.association.label), assume_unique=True)
            if len(more) and failed < _FAILURES:
                tried = np.append(tried, more[0])
                labels = np.append(best.association.label, more[0])
            else:
                assert best.estimate is not None
                doubted = doubted_labels(best.rays, best.association, best.keyframes, best.estimate)
                if not len(doubted):
                    return best, doubtful
                doubtful = best if doubtful is None else doubtful
                tried, labels, best = np.union1d(tried, doubted), np.setdiff1d(best.association.label, doubted), None
        if not _show_path(named, labels):
            return None, doubtful
        some = _of_labels(named, labels)
        try:
            begin, start = (state, _path_of(state, some)) if best is None else (best, best.solved_poses)
            solved = begin.attempt().solve("labels", some, start)
        except SolveError:
            return None, doubtful


def _path_of(state: JointState, some: Association) -> Floats | None:
    """Return the camera poses (K, 4, 4) after a solve of the keyframes that show objects of an association. Return None if
    all keyframes show objects, or if there is a localisation.

    A solve without a localisation begins with a graph that grows by some keyframes at a time. Keyframes that show only a
    moving thing may lead this graph to a wrong minimum. A solve without these keyframes does not end at this minimum. state:
    before the first solve.
    """
    shown = some.object >= 0
    if state.keyframes.localized_every or len(np.unique(state.rays.keyframe[shown])) == len(state.keyframes):
        return None
    errors = state.errors
    if errors is None:
        keyframes, rays = seen_something(state.keyframes, state.rays.take(shown))
    else:
        errors = errors.take(*seen_something(errors.keyframes, errors.rays.take(shown)))
        keyframes, rays, _ = errors.at(errors.mean if state.theta is None else state.theta)
    fewer = replace(state.attempt(), keyframes=keyframes, rays=rays, errors=errors)
    estimate = fewer.solve_once(Association(some.object[shown], some.label), errors)
    every, mine = state.keyframes, fewer.keyframes
    at = correct_poses(every.stamps, every.map_T_base, mine.stamps, mine.map_T_base, estimate.map_T_base)
    return np.asarray(at @ every.base_T_camera)


def _by_fit(solved: JointState) -> Ints:
    """Return the labels whose rays meet at the path of a map of some labels. The labels whose rays fit best come first."""
    from objslam.graph.fixed_pose_triangulation import triangulate_at

    association = associate_by_label(solved.rays)
    found = triangulate_at(solved.solved_poses, solved.keyframes, solved.rays, association, solved.settings)
    beyond, number = rays_beyond(solved, association, np.where(found.ok[:, None], found.positions, np.nan))
    order = np.argsort(beyond / np.maximum(number, 1), kind="stable")
    return association.label[order[number[order] > 0]]


def _of_labels(named: JointState, labels: Ints) -> Association:
    """Return the association of a map with one object for each label, reduced to some labels."""
    before = named.association
    assert before is not None
    stays = np.isin(before.label, labels)
    number = np.append(np.where(stays, np.cumsum(stays) - 1, -1), -1)
    return Association(number[before.object], before.label[stays])


def _show_path(named: JointState, labels: Ints) -> bool:
    """Return whether some labels show the path. At least `OTHERS` labels need `MANY` rays each. Without a localisation,
    enough of the labels must also be seen at each moment (`unchecked_labels`)."""
    rays = named.rays
    of_them = np.isin(rays.label, labels)
    if (np.bincount(rays.label[of_them]) >= MANY).sum() < OTHERS:
        return False
    if named.keyframes.localized_every or of_them.all():
        return True
    first = rays.label[~of_them][0]
    as_one = replace(rays, label=np.where(of_them, rays.label, first))
    return bool(first not in unchecked_labels(as_one, named.keyframes))
