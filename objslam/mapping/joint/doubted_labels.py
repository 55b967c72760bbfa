"""Doubt whether each label names a single object, and compare with a map that has several objects for a label.

A map with one object for two things bends the path, so that both things lie in one place. A solve that estimates the noise
explains the bend by noise of the odometry, and then all rays agree. So the rays do not show that the label has two objects.
Only a comparison of the evidence for both maps, at the same noise, shows it.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from objslam.core.arrays import Bools, Ints
from objslam.core.geometry import angles_off
from objslam.core.noise import NoiseFactors
from objslam.core.types import Association, Keyframes, Rays
from objslam.mapping.joint.labels import MANY, SECOND

if TYPE_CHECKING:
    from objslam.core.estimate import Estimate
    from objslam.mapping.joint.joint_alternation import JointState
    from objslam.mapping.solution import Solution

_WITNESSES = 2
"""The least number of other labels that must be seen before and after a moment, to check a label at this moment. The places
of two objects fix a motion on the floor, so that the path between them cannot bend. With fewer, a bend can bring two things
to one place. A larger number doubts the labels of more logs. MRCLAM and Lost in the Woods have 2 and more everywhere."""
_GREW = 1.2
"""Labels are doubted if a solve finds a larger factor than this on the noise of the odometry. A bent path needs such noise.
In simulated drives with a turn on the spot and two things of one label, the factor was 1.5 to 6, and mostly 4. With one
thing for each label and the odometry of the settings, it was at most 1.1. A larger factor doubts fewer labels."""
_MISSED, _TAIL = 1.5, 0.9
"""All labels are doubted if, in a solve with noisy odometry, single boxes miss by more than `_MISSED` times their nominal
noise. If several labels have two objects each, they cannot check one another, but their boxes miss. The miss is read from
the share `_TAIL` of the boxes, because a bent path lets some boxes fit well. With one thing for each label, simulated rigs
of three cameras miss by 0.7 to 0.9, and six drives with two labels of two things by 1.9 to 4.7. A larger `_MISSED` doubts
fewer labels, and a smaller one explores more logs without need. A larger `_TAIL` takes wrong names for noise."""
_NOISY_BOXES = 2.0
"""A map needs noisy boxes if a solve finds a larger factor than this on their noise. The recorded wheel robots have 0.5 to
1.2 with one thing for each label. A larger factor trusts more maps with one object for each label."""
_REJECTED = 0.1
"""A label is doubted if at least `MANY` of its rays, and at least this share, are rejected. A larger share doubts fewer
labels. In a smaller share, a second object cannot be distinguished from wrong names and false boxes."""
_NOISIER = 1.5
"""A map with one object for each label may need this multiple of the noise of boxes or depths that a map with several
objects needs. A larger factor favours one object for each label."""


CLEAR_ODDS = 7.0
"""The evidence is clear if the log of the odds is above this: 1000 to 1. Bent paths of simulated drives had 107 and more.
With a larger value, more maps need a look."""


def doubted_names(state: JointState | Solution) -> tuple[str, ...]:
    """Return the names of the `doubted_labels` of a map with one object for each label."""
    assert state.association is not None
    assert state.estimate is not None
    doubted = doubted_labels(state.rays, state.association, state.keyframes, state.estimate)
    return tuple(state.rays.label_names[i] for i in doubted.tolist())


def has_several(other: JointState, named: JointState) -> bool:
    """Return whether a label has several objects in the map `other`, and one in the map `named`."""
    assert other.association is not None
    assert named.association is not None
    most = len(named.rays.label_names)
    several, one = (np.bincount(found.label, minlength=most) for found in (other.association, named.association))
    return bool(((several > 1) & (one == 1)).any())


def has_labels_of(one: JointState, other: JointState) -> bool:
    """Return whether a map has an object for each label that has one in another map."""
    assert one.association is not None
    assert other.association is not None
    return bool(np.isin(other.association.label, one.association.label).all())


def needs_noisy_boxes(named: JointState, other: JointState) -> bool:
    """Return whether the map `named`, with one object for each label, needs far noisier boxes than another map of the log.

    Then `named` is not trusted, even if `other` has less evidence. The exploration of `other` may only have missed a thing.
    """
    assert named.errors is not None
    assert other.errors is not None
    return named.errors.noise.rays > max(_NOISY_BOXES, _NOISIER * other.errors.noise.rays)


def doubted_labels(rays: Rays, association: Association, keyframes: Keyframes, estimate: Estimate) -> Ints:
    """Return the labels that may name several objects, though the rays agree with a map of one object for each label.

    With a localisation no label is doubted, because the localisation keeps the path from bending. If the map needs noisy
    odometry and noisy boxes, all labels with enough rays for two objects are doubted. If it needs noisy odometry alone, the
    labels that too few others check (`unchecked_labels`) are doubted. If it needs neither, an unchecked label is doubted
    only if the map rejects many of its rays.

    Args:
        rays: the rays, with their labels.
        association: the object of each ray. A second box of a label in one frame may have no object. Labels without an
            object are not judged, and check no other label.
        keyframes: the keyframes of the rays.
        estimate: the solved map of one object for each label.
    """
    noise = estimate.noise
    if keyframes.localized_every or noise is None:
        return np.zeros(0, dtype=np.int64)
    of_map = np.isin(rays.label, association.label)
    unchecked = unchecked_labels(rays.take(of_map), keyframes)
    if max(noise.along, noise.across, noise.turning) > _GREW:
        enough = np.flatnonzero(np.bincount(rays.label[of_map]) >= 2 * MANY)
        return enough if _missed(rays, association, keyframes, estimate, noise.rays) > _MISSED else unchecked
    count, held = len(rays.label_names), association.object >= 0
    rejected, number = (np.bincount(rays.label[which], minlength=count) for which in (held & (estimate.weight == 0), held))
    return unchecked[(rejected >= np.maximum(MANY, _REJECTED * number))[unchecked]]


def _missed(rays: Rays, association: Association, keyframes: Keyframes, estimate: Estimate, factor: float) -> float:
    """Return by which multiple of their nominal noise single boxes miss: a quantile of their angles, over Rayleigh's.

    The factor on the noise of rays is larger if boxes of one thing err alike for seconds, as boxes beside their things do.
    Several cameras show this, because they hold each pose. Two things do not. factor: the one that is in the rays' sigmas.
    """
    held = association.object >= 0
    origins, directions = rays.in_map(estimate.map_T_base @ keyframes.base_T_camera)
    off = angles_off(origins[held], directions[held], estimate.positions[association.object[held]])
    off = (off / rays.sigma[held])[np.isfinite(off)]
    return factor * float(np.quantile(off, _TAIL)) / np.sqrt(-2 * np.log(1 - _TAIL)) if len(off) else 0.0


def unchecked_labels(rays: Rays, keyframes: Keyframes) -> Ints:
    """Return the labels for which too few other labels (`_WITNESSES`) could show a second object.

    The rays of a label are divided at a moment, so that each part is large enough for an object of its own. Another label is
    a witness if it has rays before and after this moment. A label is unchecked if it has such a moment with too few
    witnesses.

    Args:
        rays: the rays, with their labels.
        keyframes: the keyframes of the rays.
    """
    stamps = keyframes.stamps[rays.keyframe]
    order = np.lexsort((stamps, rays.label))
    at = stamps[order]
    labels, first, number = np.unique(rays.label[order], return_index=True, return_counts=True)
    enough = number >= 2 * MANY
    labels, first, number = labels[enough], first[enough], number[enough]
    begin, end = at[first + MANY - 1], at[first + number - MANY]  # Between them, a label has rays before and after.
    part = np.maximum(MANY, np.ceil(SECOND * number).astype(np.int64))
    changes = np.sort(np.concatenate([begin, end]))
    begin, end = np.sort(begin), np.sort(end)
    unchecked = []
    for label, low, high in zip(labels.tolist(), at[first + part - 1], at[first + number - part], strict=True):
        moments = np.append(low, changes[np.searchsorted(changes, low, "right") : np.searchsorted(changes, high)])
        seen = np.searchsorted(begin, moments, "right") - np.searchsorted(end, moments, "right")
        if low < high and seen.min() - 1 < _WITNESSES:  # One of them is the label itself.
            unchecked.append(label)
    return np.array(unchecked, dtype=np.int64)


def evidence_against(named: JointState, other: JointState) -> float:
    """Return the log of the odds for the association of the map `other`, against the association of the map `named`.

    Both maps are compared at the noise of the odometry that `named` found, which suits `named` best. At the noise of the
    settings, `named` would lose even if it is right, in a log of a robot with worse odometry: a second object costs less
    than the error of the path. The noise of boxes and depths shows in each view, whatever the objects are. If `other` found
    much less of it than `named`, both maps are compared at `_NOISIER` times the noise of `other`. A second box around one
    thing has no object in `named`, so here it has none in `other`. Each map keeps its own shared errors, which count by
    their prior.

    Args:
        named: solved, with one object for each label.
        other: solved, of the same rays.
    """
    assert named.errors is not None
    assert other.errors is not None
    found, most = named.errors.noise, other.errors.noise
    sensors = {name: min(getattr(found, name), _NOISIER * getattr(most, name)) for name in ("rays", "ranges", "range_bias")}
    held = replace(found, by_label=(), **sensors)  # The noise of single labels would pass the limit.
    assert named.association is not None
    counts = named.association.object >= 0
    return _explained_at(held, other, counts) - _explained_at(held, named, counts)


def _explained_at(noise: NoiseFactors, state: JointState, counts: Bools) -> float:
    """Return the log evidence for the association of a state at another noise, with the prior of its shared errors.

    counts: (R,) the rays that may have an object.
    """
    assert state.errors is not None
    assert state.association is not None
    theta = state.errors.mean if state.theta is None else state.theta
    there = replace(state.attempt(), theta=theta, hold=True)
    association = replace(state.association, object=np.where(counts, state.association.object, -1))
    solved = there.solve_once(association, state.errors.with_noise(noise), state.solved_poses)
    off = theta - state.errors.mean
    return solved.log_evidence - float(off @ np.linalg.solve(state.errors.prior, off)) / 2
