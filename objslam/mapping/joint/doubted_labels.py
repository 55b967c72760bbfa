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
"""To check a label at a moment, at least this number of other labels must be seen before and after the moment. The places of
two objects fix a motion on the floor, so the path cannot bend at this moment. With fewer objects, a bend can bring two
things to one place. With a larger number, labels of more logs are doubted. MRCLAM and Lost in the Woods have 2 and more
everywhere."""
_GREW = 1.2
"""The factor on the noise of the odometry above which labels are doubted. A bent path needs such noise. In simulated drives
with a turn on the spot and two things of one label, the factor was 1.5 to 6, and mostly 4. With one thing for each label and
the odometry of the settings, it was at most 1.1. With a larger factor, fewer labels are doubted."""
_MISSED, _TAIL = 1.5, 0.9
"""In a solve with noisy odometry, all labels are doubted if single boxes miss by at least `_MISSED` times their nominal
noise. If several labels have two objects each, they cannot check one another, but their boxes miss. `_TAIL` is the quantile
of the misses that is compared, because a bent path lets some boxes fit well. With one thing for each label, simulated rigs
of three cameras miss by 0.7 to 0.9. Six drives with two labels of two things miss by 1.9 to 4.7. With a larger `_MISSED`,
fewer labels are doubted. With a smaller one, more logs are explored without need. With a larger `_TAIL`, wrong names are
taken for noise."""
_NOISY_BOXES = 2.0
"""The factor on the noise of boxes above which a map needs noisy boxes. The recorded wheel robots have 0.5 to 1.2 with one
thing for each label. With a larger factor, more maps with one object for each label are trusted."""
_REJECTED = 0.1
"""A label is doubted if at least this share of its rays is rejected. At least `MANY` rays must be rejected too. With a
larger share, fewer labels are doubted. With a smaller share, wrong names and false boxes look like a second object."""
_NOISIER = 1.5
"""The largest noise of boxes or depths that a map with one object for each label may need, as a multiple of the noise that a
map with several objects needs. A larger factor favours one object for each label."""


CLEAR_ODDS = 7.0
"""The natural log of the odds above which evidence is clear. It means odds of about 1000 to 1. Bent paths of simulated
drives had 107 and more. With a larger value, more labels stay doubted."""


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
    """Return whether the map `one` has an object for each label that has an object in the map `other`."""
    assert one.association is not None
    assert other.association is not None
    return bool(np.isin(other.association.label, one.association.label).all())


def needs_noisy_boxes(named: JointState, other: JointState) -> bool:
    """Return whether the map `named`, with one object for each label, needs far noisier boxes than another map of the log.

    If so, `named` is not trusted, even if `other` has less evidence, because the exploration of `other` may have missed a
    thing.
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
    """Return the multiple of their nominal noise by which single boxes miss. It is a quantile of their angles, divided by
    the same quantile of a Rayleigh distribution.

    The estimated factor on the noise of rays would be no such measure. It also grows if boxes of one thing err alike for
    seconds, as boxes beside their things do. Several cameras show this, because together they fix each pose. factor: the
    factor that the sigmas of the rays contain.
    """
    held = association.object >= 0
    origins, directions = rays.in_map(estimate.map_T_base @ keyframes.base_T_camera)
    off = angles_off(origins[held], directions[held], estimate.positions[association.object[held]])
    off = (off / rays.sigma[held])[np.isfinite(off)]
    return factor * float(np.quantile(off, _TAIL)) / np.sqrt(-2 * np.log(1 - _TAIL)) if len(off) else 0.0


def unchecked_labels(rays: Rays, keyframes: Keyframes) -> Ints:
    """Return the labels for which too few other labels (`_WITNESSES`) could show a second object.

    A moment divides the rays of a label in two parts. Only moments count at which each part is large enough for an object.
    Another label is a witness if it has rays before and after the moment. A label is unchecked if there is a moment with too
    few witnesses.

    Args: rays: the rays, with their labels. keyframes: the keyframes of the rays.
    """
    stamps = keyframes.stamps[rays.keyframe]
    order = np.lexsort((stamps, rays.label))
    at = stamps[order]
    labels, first, number = np.unique(rays.label[order], return_index=True, return_counts=True)
    enough = number >= 2 * MANY
    labels, first, number = labels[enough], first[enough], number[enough]
    begin, end = at[first + MANY - 1], at[first + number - MANY]  # Between the two, a label has rays before and after.
    part = np.maximum(MANY, np.ceil(SECOND * number).astype(np.int64))
    changes = np.sort(np.concatenate([begin, end]))
    begin, end = np.sort(begin), np.sort(end)
    unchecked = []
    for label, low, high in zip(labels.tolist(), at[first + part - 1], at[first + number - part], strict=True):
        moments = np.append(low, changes[np.searchsorted(changes, low, "right") : np.searchsorted(changes, high)])
        seen = np.searchsorted(begin, moments, "right") - np.searchsorted(end, moments, "right")
        if low < high and seen.min() - 1 < _WITNESSES:  # One of the seen labels is the label itself.
            unchecked.append(label)
    return np.array(unchecked, dtype=np.int64)


def evidence_against(named: JointState, other: JointState) -> float:
    """Return the log odds of the association of the map `other` over the association of the map `named`.

    Both maps are compared at the noise of the odometry that `named` found, which suits `named` best. At the noise of the
    settings, `named` could lose even if it is right. With worse odometry than the settings say, a second object would cost
    less than the error of the path. The noise of boxes and depths shows in each view, also with wrong objects. If `other`
    found much less of this noise than `named`, both maps are compared at `_NOISIER` times the noise of `other`. Rays without
    an object in `named`, such as second boxes around one thing, have none in `other` here. Each map keeps its own shared
    errors, which count by their prior.

    Args: named: a solved map, with one object for each label. other: another solved map of the same rays.
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
