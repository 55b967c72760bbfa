"""Judge whether each label names a single object. Then the labels alone decide which rays belong together."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from objslam.association.nearest_neighbour import associate_by_label
from objslam.core.calibration import kind
from objslam.core.geometry import angles_off
from objslam.core.noise import NOMINAL
from objslam.core.types import Association

if TYPE_CHECKING:
    from collections.abc import Callable

    from objslam.config import Settings
    from objslam.core.arrays import Bools, Floats, Ints
    from objslam.core.diagnostics import Ledger
    from objslam.core.estimate import Estimate
    from objslam.core.types import Keyframes, Rays
    from objslam.frontend.shared_errors import SharedErrors
    from objslam.mapping.joint.joint_alternation import JointState
    from objslam.mapping.solution import Solution

MANY, SECOND = 5, 0.25
"""A label has a second object if at least `MANY` of its rays, and more than the share `SECOND`, are rejected. Larger values
find fewer second objects."""
_DOUBLE = 0.1
"""One object for each label is tried if at most this share of the pairs of a label and a keyframe has several boxes. A
detector draws some boxes twice, and some false ones. With a larger share, more logs are tried without success. Each try
takes a solve."""
_AGREES = 3.0
"""A ray agrees with the object of its label if it is off by at most this many standard deviations. With a larger value,
fewer boxes can show a second object."""
OTHERS = 3
"""The fewest objects with `MANY` rays whose usual noise judges the label of each one. With a larger number, fewer logs are
judged."""
_JUDGEMENTS = 2
"""How many times `noise_explains` solves, each time with the noise that the last solve found. A solve that rejects rays
finds too little noise, so a second solve finds more. A larger number is slower."""
_SAME_NOISE = 0.1
"""`noise_explains` does not solve again if the noise changes by less than this share. A larger value ends sooner."""

_CLOCKS = (-1.0, 1.0, -2.0, 2.0)
"""The clock offsets that `clock_explains` tries, in standard deviations of their prior. A solve converges from one standard
deviation away, so a denser grid is slower and finds nothing new. A wider grid finds clocks that the prior excludes."""
_SHORT = 500
"""`clock_explains` tries clock offsets for logs with at most this number of keyframes. A longer log has enough rays to find
its clock in one solve. A larger number is slower."""

_LARGER = 1.5
"""`warn_of_noise` names a kind of noise if the log shows more than this multiple of its noise in the settings. A larger
multiple names fewer kinds."""


def may_be_by_label(settings: Settings, rays: Rays) -> bool:
    """Return whether to try one object for each label.

    association.method decides. `by_label` means yes. `auto` means yes if hardly any keyframe has two rays of one label.
    """
    if settings.association.method != "auto":
        return settings.association.method == "by_label"
    _, number = np.unique(np.stack([rays.keyframe, rays.label]), axis=1, return_counts=True)
    return bool((number > 1).sum() <= _DOUBLE * len(number))


def angles_to_objects(rays: Rays, estimate: Estimate, map_T_camera: Floats) -> Floats:
    """Return the angle (R,), rad, between each ray and the object of its label, NaN if the object has no position.

    estimate: with one object for each label. map_T_camera: (K, 4, 4) the solved poses.
    """
    origins, directions = rays.in_map(map_T_camera)
    return angles_off(origins, directions, estimate.positions[np.searchsorted(np.unique(rays.label), rays.label)])


def shows_second_object(
    rays: Rays, association: Association, estimate: Estimate, keyframes: Keyframes, map_T_camera: Floats, settings: Settings
) -> bool:
    """Return whether a label has a second object: rays without an object meet in one point, more closely than by chance.

    Three kinds of rays do not count. The first agree with the object of their label. The second have a box around that
    object, which has another box in the same keyframe. The third have a wrong name (`_misnamed`). keyframes: of the rays.
    map_T_camera: (K, 4, 4) the solved poses.
    """
    from objslam.graph.fixed_pose_triangulation import triangulate_at

    off = angles_to_objects(rays, estimate, map_T_camera)
    other = (association.object < 0) & ~(off <= _AGREES * rays.sigma) & ~_drawn_twice(rays, association)
    other &= ~_misnamed(rays, association, estimate, map_T_camera)
    others = Association(np.where(other, np.searchsorted(association.label, rays.label), -1), association.label)
    found = triangulate_at(map_T_camera, keyframes, rays, others, settings)
    return bool((found.ok & (found.counts >= settings.association.min_rays)).any())


def _drawn_twice(rays: Rays, association: Association) -> Bools:
    """Return which rays (R,) have a second box around the object of their label. Its first box is in the same keyframe, and
    the centre of one of the two boxes is inside the other box."""
    held = np.flatnonzero(association.object >= 0)
    key = rays.keyframe * len(rays.label_names) + rays.label
    order = held[np.argsort(key[held], kind="stable")]
    twin = order[np.minimum(np.searchsorted(key[order], key), len(order) - 1)]
    own, other = rays.box, rays.box[twin]
    return (key[twin] == key) & (_contains(own, other) | _contains(other, own))


def _misnamed(rays: Rays, association: Association, estimate: Estimate, map_T_camera: Floats) -> Bools:
    """Return which rays (R,) without an object agree with the object of another label, which has no box in their keyframe.

    A detector sometimes gives a box a wrong name. Then the object misses a box, and the label has one too many. Several of
    these boxes may be of one object, so their rays meet there.
    """
    asked = np.flatnonzero(association.object < 0)
    origins, directions = rays.in_map(map_T_camera)
    off = angles_off(origins[asked, None], directions[asked, None], estimate.positions)
    seen = np.zeros((len(map_T_camera), association.count), dtype=bool)
    held = association.object >= 0
    seen[rays.keyframe[held], association.object[held]] = True
    near = (off <= _AGREES * rays.sigma[asked, None]) & ~seen[rays.keyframe[asked]]
    misnamed = np.zeros(len(rays), dtype=bool)
    misnamed[asked] = near.any(axis=1)
    return misnamed


def _contains(boxes: Floats, others: Floats) -> Bools:
    """Return whether boxes (R, 4) contain the centres of other boxes (R, 4)."""
    centre = (others[:, :2] + others[:, 2:]) / 2
    return np.asarray(((boxes[:, :2] <= centre) & (centre <= boxes[:, 2:])).all(axis=1))


def labels_tell(association: Association, estimate: Estimate) -> bool:
    """Return whether every label is one object: no label is `rejected`. False if no object has a position."""
    return bool(np.isfinite(estimate.positions[:, 0]).any()) and not rejected(association, estimate).any()


def rejected(association: Association, estimate: Estimate) -> Bools:
    """Return the objects (N,) with many rejected rays (`MANY`).

    An object without a position is ignored, because its rays may only have too little parallax.
    """
    held = association.object >= 0
    number = np.bincount(association.object[held], minlength=association.count)
    beyond = np.bincount(association.object[held & (estimate.weight == 0)], minlength=association.count)
    placed = np.isfinite(estimate.positions[:, 0])
    return np.asarray(placed & (beyond >= MANY) & (beyond > SECOND * number))


def scatter_alone(named: JointState | Solution) -> Bools:
    """Return the objects (N,) with which their rays agree only at noise that the rays of other labels do not have.

    A person who walks has a label, but no place. A solve explains such rays by noisy boxes. Then hardly a ray is rejected,
    and only the other labels show how noisy the boxes are. A label scatters alone if at least `MANY` of its rays, and more
    than the share `SECOND`, are off by more than `_AGREES` times the usual noise of an object. The noise of the settings
    counts if it is larger. named: a map with one object for each label, whose rays have sigmas by its own noise.
    """
    association, estimate = named.association, named.estimate
    assert association is not None
    assert estimate is not None
    beyond, number = rays_beyond(named, association, estimate.positions)
    return np.asarray((beyond >= MANY) & (beyond > SECOND * number))


def known_names(solved: JointState) -> Association | None:
    """Return the objects of the labels of a map with one object for each of its labels, with the nearest box in each frame.

    A label needs `MANY` rays that agree. With fewer, a misread box among them would hardly be noticed. None if other boxes
    show a second object of any label. solved: the map. The log may have more labels.
    """
    before = solved.association
    assert before is not None
    assert solved.estimate is not None
    mine = np.flatnonzero(np.isin(solved.rays.label, before.label))
    rays = solved.rays.take(mine)
    nearest = associate_by_label(rays, angles_to_objects(rays, solved.estimate, solved.solved_poses))
    given = solved.estimate, solved.keyframes, solved.solved_poses, solved.settings
    if (nearest.object < 0).any() and shows_second_object(rays, nearest, *given):
        return None
    clear = np.bincount(before.object[solved.agree], minlength=before.count) >= MANY
    number = np.append(np.where(clear, np.cumsum(clear) - 1, -1), -1)
    object_ = np.full(len(solved.rays), -1)
    object_[mine] = number[nearest.object]
    return Association(object_, nearest.label[clear])


def rays_beyond(named: JointState | Solution, association: Association, positions: Floats) -> tuple[Ints, Ints]:
    """Return how many rays of each object (N,) are off by more than `_AGREES` times the usual noise, and of how many rays.

    The usual noise is the one of the objects whose labels are in the map `named`. Both numbers are zero for objects with
    fewer than `MANY` rays, and for all objects if fewer than `OTHERS` show the usual noise. association: of the rays of the
    map, with its labels or more. positions: (N, 3) m of the objects at the path of the map, NaN if unknown.
    """
    assert named.association is not None
    assert named.estimate is not None
    origins, directions = named.rays.in_map(named.estimate.map_T_base @ named.keyframes.base_T_camera)
    known = np.flatnonzero(np.isfinite(positions[association.object, 0]) & (association.object >= 0))
    owner = association.object[known]
    off = angles_off(origins[known], directions[known], positions[owner]) / named.rays.sigma[known]
    number = np.bincount(owner, minlength=association.count)
    many = number >= MANY
    usual = many & np.isin(association.label, named.association.label)
    if usual.sum() < OTHERS:
        return np.zeros_like(number), np.zeros_like(number)
    spread = np.sqrt(np.bincount(owner, off**2, association.count) / np.maximum(number, 1))
    nominal = 1.0 if named.estimate.noise is None else 1 / named.estimate.noise.rays
    limit = _AGREES * max(float(np.median(spread[usual])), nominal)
    return np.bincount(owner[off > limit], minlength=association.count) * many, number * many


def clock_explains(association: Association, errors: SharedErrors, solve: Callable[[Floats], Estimate]) -> Floats | None:
    """Return shared errors (P,) from which a solve finds one object for each label. None if there are none.

    A solve that starts with a wrong clock offset rejects true rays. In a short log, too few rays are left to find the clock.
    So the solve is tried from each clock offset in `_CLOCKS`. solve: solves once, from the given shared errors (P,).
    """
    clocks = np.array([kind(name) == "clock" for name in errors.names], dtype=bool)
    if not clocks.any() or len(errors.keyframes) > _SHORT:
        return None
    for share in _CLOCKS:
        theta = errors.mean + share * np.where(clocks, np.sqrt(np.diagonal(errors.prior)), 0.0)
        theta = np.clip(theta, -errors.bounds, errors.bounds)
        if labels_tell(association, solve(theta)):
            return theta
    return None


def noise_explains(
    association: Association, estimate: Estimate, errors: SharedErrors, solve: Callable[[SharedErrors], Estimate]
) -> Estimate | None:
    """Return an estimate with larger noise in which each label is one object. None if larger noise does not help.

    With too little noise in the settings, poses cannot move far enough. Then the rays of one object look like rays of
    several. So the noise is estimated, even if the settings fix it, and the labels are judged again.

    estimate: a solution in which some label has many rejected rays. errors: the shared errors of the log. solve: solves
    once.
    """
    errors = errors.with_unknown_noise()
    before = NOMINAL if estimate.noise is None else estimate.noise
    for _ in range(_JUDGEMENTS):
        estimate = solve(errors)
        if labels_tell(association, estimate):
            return estimate
        if estimate.noise is None or estimate.noise.like(before, _SAME_NOISE):
            return None
        before = estimate.noise
        errors = errors.with_noise(before)
    return None


def warn_of_noise(errors: SharedErrors, estimate: Estimate, ledger: Ledger) -> None:
    """Warn if the settings fix the noise, and `estimate` found more. In `estimate`, each label is one object."""
    said = errors.with_unknown_noise().unknown_noise - errors.unknown_noise
    if estimate.noise is None or not said:
        return
    factors = ", ".join(f"{kind} {factor:.2g}" for kind, factor in estimate.noise.to_dict(None).items() if factor > _LARGER)
    if factors:
        ledger.warn(
            f"the settings have too little noise for this log (factors found: {factors}), and many boxes are rejected; "
            f"leave the noise out of the settings, or set {', '.join(f'noise.{kind}=true' for kind in sorted(said))}"
        )
