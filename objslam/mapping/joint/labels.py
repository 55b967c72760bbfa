"""Judge whether each label names a single object. If so, the labels alone decide which rays belong together."""

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
"""A label has a second object if at least this number and this share of its rays are rejected. With larger values, fewer
second objects are found."""
_DOUBLE = 0.1
"""One object for each label is tried if at most this share of the pairs of a label and a keyframe have several boxes. A
detector draws some boxes twice, and draws some false boxes. With a larger share, more logs are tried without success. Each
try takes a solve."""
_AGREES = 3.0
"""The largest miss, in standard deviations, of a ray that agrees with the object of its label. With a larger value, fewer
boxes can show a second object."""
OTHERS = 3
"""The fewest objects with `MANY` rays that show the usual noise, by which each label is judged. With a larger number, fewer
logs are judged."""
_JUDGEMENTS = 2
"""The number of solves in `noise_explains`. Each begins with the noise that the last solve found. A solve that rejects rays
finds too little noise, so a second solve finds more. A larger number is slower."""
_SAME_NOISE = 0.1
"""The share by which the noise must change, so that `noise_explains` solves again. With a larger value, it ends sooner."""

_CLOCKS = (-1.0, 1.0, -2.0, 2.0)
"""The clock offsets that `clock_explains` tries, in standard deviations of their prior. A solve converges from one standard
deviation away, so closer values would take time and find nothing new. Larger values find clocks that the prior excludes."""
_SHORT = 500
"""The most keyframes of a log for which `clock_explains` tries clock offsets. A longer log has enough rays to find its clock
in one solve. A larger number is slower."""

_LARGER = 1.5
"""The multiple of the noise in the settings above which `warn_of_noise` names a kind of noise. With a larger multiple, fewer
kinds are named."""


def may_be_by_label(settings: Settings, rays: Rays) -> bool:
    """Return whether to try one object for each label.

    association.method decides. `by_label` means yes. `auto` means yes if hardly any keyframe has several rays of one label.
    Any other method means no.
    """
    if settings.association.method != "auto":
        return settings.association.method == "by_label"
    _, number = np.unique(np.stack([rays.keyframe, rays.label]), axis=1, return_counts=True)
    return bool((number > 1).sum() <= _DOUBLE * len(number))


def angles_to_objects(rays: Rays, estimate: Estimate, map_T_camera: Floats) -> Floats:
    """Return the angle (R,) in rad between each ray and the object of its label. It is NaN if the object has no position.

    estimate: with one object for each label. map_T_camera: (K, 4, 4) the solved poses.
    """
    origins, directions = rays.in_map(map_T_camera)
    return angles_off(origins, directions, estimate.positions[np.searchsorted(np.unique(rays.label), rays.label)])


def shows_second_object(
    rays: Rays, association: Association, estimate: Estimate, keyframes: Keyframes, map_T_camera: Floats, settings: Settings
) -> bool:
    """Return whether a label has a second object, because rays without an object meet in one point.

    Three kinds of rays do not count: rays that agree with the object of their label, rays of a second box around that object
    (`_drawn_twice`), and rays of boxes with a wrong name (`_misnamed`). keyframes: of the rays. map_T_camera: (K, 4, 4) the
    solved poses.
    """
    from objslam.graph.fixed_pose_triangulation import triangulate_at

    off = angles_to_objects(rays, estimate, map_T_camera)
    other = (association.object < 0) & ~(off <= _AGREES * rays.sigma) & ~_drawn_twice(rays, association)
    other &= ~_misnamed(rays, association, estimate, map_T_camera)
    others = Association(np.where(other, np.searchsorted(association.label, rays.label), -1), association.label)
    found = triangulate_at(map_T_camera, keyframes, rays, others, settings)
    return bool((found.ok & (found.counts >= settings.association.min_rays)).any())


def _drawn_twice(rays: Rays, association: Association) -> Bools:
    """Return a mask (R,) of the rays whose box and another box of the same keyframe are around one object. The other box
    belongs to the object of their label. The centre of one of the two boxes is inside the other box."""
    held = np.flatnonzero(association.object >= 0)
    key = rays.keyframe * len(rays.label_names) + rays.label
    order = held[np.argsort(key[held], kind="stable")]
    twin = order[np.minimum(np.searchsorted(key[order], key), len(order) - 1)]
    own, other = rays.box, rays.box[twin]
    return (key[twin] == key) & (_contains(own, other) | _contains(other, own))


def _misnamed(rays: Rays, association: Association, estimate: Estimate, map_T_camera: Floats) -> Bools:
    """Return a mask (R,) of the rays without an object that agree with the object of another label. This object has no box
    in the keyframe of the ray.

    A detector sometimes gives a box a wrong name. Then the object lacks a box, and the wrong label has one box too many.
    Several such boxes may be of one object, so their rays meet in one point.
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
    """Return whether each box (R, 4) contains the centre of the other box (R, 4) in the same row."""
    centre = (others[:, :2] + others[:, 2:]) / 2
    return np.asarray(((boxes[:, :2] <= centre) & (centre <= boxes[:, 2:])).all(axis=1))


def labels_tell(association: Association, estimate: Estimate) -> bool:
    """Return whether every label is one object, because no label is `rejected`. The result is False if no object has a
    position."""
    return bool(np.isfinite(estimate.positions[:, 0]).any()) and not rejected(association, estimate).any()


def rejected(association: Association, estimate: Estimate) -> Bools:
    """Return a mask (N,) of the objects with many rejected rays (`MANY`, `SECOND`).

    An object without a position does not count, because its rays may only have too little parallax.
    """
    held = association.object >= 0
    number = np.bincount(association.object[held], minlength=association.count)
    beyond = np.bincount(association.object[held & (estimate.weight == 0)], minlength=association.count)
    placed = np.isfinite(estimate.positions[:, 0])
    return np.asarray(placed & (beyond >= MANY) & (beyond > SECOND * number))


def scatter_alone(named: JointState | Solution) -> Bools:
    """Return a mask (N,) of the objects whose rays agree only at noise that the rays of other labels do not have.

    A person who walks has a label, but no fixed place. A solve explains the rays to this person by noisy boxes. Then hardly
    any ray is rejected, and only the other labels show how noisy the boxes are. A label scatters alone if at least `MANY` of
    its rays, and more than the share `SECOND`, are off by more than `_AGREES` times the usual noise of an object. The noise
    of the settings counts if it is larger. named: a map with one object for each label. The sigmas of its rays contain the
    noise that its solve found.
    """
    association, estimate = named.association, named.estimate
    assert association is not None
    assert estimate is not None
    beyond, number = rays_beyond(named, association, estimate.positions)
    return np.asarray((beyond >= MANY) & (beyond > SECOND * number))


def known_names(solved: JointState) -> Association | None:
    """Return the association of the labels that are known to be names, with the nearest box of each label in each frame.

    A label needs `MANY` rays that agree. With fewer, a box with a wrong name would hardly be noticed. Return None if other
    boxes show a second object of any label. solved: a map with one object for each of its labels. The log may have more
    labels.
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
    """Return two numbers (N,) for each object: its rays that are off by more than `_AGREES` times the usual noise, and all
    its rays.

    The usual noise is that of the objects whose labels are in the map `named`. Both numbers are zero for objects with fewer
    than `MANY` rays. Both are zero for all objects if fewer than `OTHERS` objects show the usual noise. association: the
    object of each ray of the map. It may have more labels than the map. positions: (N, 3) m, of the objects at the path of
    the map, NaN if unknown.
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
    """Return shared errors (P,) from which a solve finds one object for each label. Return None if no tried clock leads to
    this.

    A solve that starts with a wrong clock offset rejects true rays. In a short log, too few rays are left to find the clock.
    So the solve is tried from each clock offset in `_CLOCKS`. solve: a function that solves once, from shared errors (P,).
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
    """Return an estimate with larger noise in which each label is one object. Return None if larger noise does not help.

    With too little noise in the settings, poses cannot move far enough. Then the rays of one object look like rays of
    several. So the noise is estimated, even if the settings fix it, and the labels are judged again.

    estimate: a solution in which some label has many rejected rays. errors: the shared errors of the log. solve: a function
    that solves once, with shared errors.
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
    """Warn if the settings fix noise of which `estimate` found more. In `estimate`, each label is one object."""
    said = errors.with_unknown_noise().unknown_noise - errors.unknown_noise
    if estimate.noise is None or not said:
        return
    factors = ", ".join(f"{kind} {factor:.2g}" for kind, factor in estimate.noise.to_dict(None).items() if factor > _LARGER)
    if factors:
        ledger.warn(
            f"the settings have too little noise for this log (factors found: {factors}), and many boxes are rejected; "
            f"leave the noise out of the settings, or set {', '.join(f'noise.{kind}=true' for kind in sorted(said))}"
        )
