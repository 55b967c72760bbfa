"""Association and solve: once where the poses are known, in turns where they move each other."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from objslam.association.duplicates import near_pairs, seen_as_two
from objslam.association.nearest_neighbour import associate_by_label
from objslam.config import Settings
from objslam.core.arrays import Floats, Ints
from objslam.core.camera import Camera
from objslam.core.diagnostics import Ledger
from objslam.core.geometry import inverse
from objslam.core.statistics import SAME_POINT
from objslam.core.trace import Round, Trace, Why
from objslam.core.trajectory import correct_poses
from objslam.core.types import Association, Keyframes, Rays
from objslam.errors import SolveError
from objslam.frontend.shared_errors import SharedErrors

if TYPE_CHECKING:
    from objslam.core.estimate import Estimate
    from objslam.graph.init_unknown_correspondences import InitialEstimate

# What solved poses still err by, seen from the objects: with it an association at them is neither too sure nor too tolerant.
_SOLVED_XY = 0.02  # m
_SOLVED_YAW = 0.005  # rad
_FIRST = 2.0  # times that, before the first solve
_USUAL = 0.12  # share of boxes that are false, or of moving things, in any log

MANY, SECOND = 5, 0.25
"""How many of a label's rays, and what share of them, disagree with its one object if there is a second; larger believes in
fewer second objects."""

Progress = Callable[[str, int, int], None]
"""Called with the stage's name, what is done and the total (0 when it is not known)."""


@dataclass(frozen=True)
class Solution:
    """Which ray belongs to which object, the estimate, and what each round of the two did.

    rays, keyframes: those that were solved, the keyframes without a ray left out; rays.keyframe counts in them. trace: for
    the recording, empty where there is none.
    """

    keyframes: Keyframes
    rays: Rays
    association: Association
    estimate: Estimate
    rounds: tuple[dict[str, int], ...]
    trace: tuple[Round, ...] = ()


def solve(
    frames: Keyframes,
    rays: Rays,
    cameras: tuple[Camera, ...],
    settings: Settings,
    ledger: Ledger,
    progress: Progress,
    start: InitialEstimate | None = None,
    errors: SharedErrors | None = None,
) -> Solution:
    """Find and solve the objects of a log; frames are all that have a pose, those without a ray too.

    start: what is known already of the keyframes with a ray, where the joint mode need not explore nor trust labels.
    errors: the errors that all measurements share, for the keyframes with a ray. Joint mode estimates them.

    Where the settings say so, every label is one object; in joint mode also where no frame has two boxes of one label, and
    the rays bear it out: the graph grows with that knowledge. Else the association is global: in fixed mode once, at the
    poses as they are; in joint mode the poses are explored first, then association and solve take turns until no ray changes
    its object.
    SolveError where joint mode has neither odometry nor localisation.
    """
    from objslam.graph import batch_solver
    from objslam.graph.fixed_pose_triangulation import pose_noise, triangulate_at

    keyframes, rays_of_keyframes = seen_something(frames, rays)
    trace = Trace(keyframes.base_T_camera) if settings.output.recording else None
    if settings.mode == "fixed":
        if not frames.localized_every:
            ledger.warn("the poses are odometry, taken as they are: the map drifts as they do (--mode joint corrects both)")
        progress("association", 0, 0)
        if settings.association.method == "by_label":
            association = associate_by_label(rays_of_keyframes)
        else:
            noise = pose_noise(rays, frames, settings)
            association = _associate(frames, rays, cameras, settings, frames.map_T_camera, noise)
        progress("solve", 0, 0)
        placed = triangulate_at(keyframes.map_T_camera, keyframes, rays_of_keyframes, association, settings)
        estimate = batch_solver.solve_fixed(keyframes, rays_of_keyframes, association, placed, settings, trace)
        if trace is not None:
            trace.end_round("fixed", association, estimate)
        _count_unexplained(rays_of_keyframes, association, ledger)
        return Solution(keyframes, rays_of_keyframes, association, estimate, (), tuple(trace.rounds if trace else ()))
    if not frames.localized_every and frames.odom_T_base is None:
        raise SolveError("the joint mode needs odometry or localisation")
    return _joint(frames, rays, keyframes, rays_of_keyframes, cameras, settings, ledger, progress, trace, start, errors)


def seen_something(keyframes: Keyframes, rays: Rays) -> tuple[Keyframes, Rays]:
    """Only the keyframes that have a ray: the others would be poses that nothing but the odometry holds."""
    kept, keyframe = np.unique(rays.keyframe, return_inverse=True)
    values = {**vars(rays), "keyframe": keyframe.astype(np.int64)}
    return keyframes.take(kept), Rays(**values)


def _joint(
    frames: Keyframes,
    all_rays: Rays,
    keyframes: Keyframes,
    rays: Rays,
    cameras: tuple[Camera, ...],
    settings: Settings,
    ledger: Ledger,
    progress: Progress,
    trace: Trace | None,
    start: InitialEstimate | None,
    errors: SharedErrors | None,
) -> Solution:
    from objslam.graph import batch_solver
    from objslam.graph.init_unknown_correspondences import initialize_unknown

    def tell(done: int, total: int) -> None:
        progress("solve", done, total)

    theta: Floats | None = None

    def solve_round(why: Why, association: Association, start: Floats | None = None) -> Estimate:
        nonlocal theta
        solved = batch_solver.solve_joint(keyframes, rays, association, settings, ledger, tell, start, trace, errors, theta)
        theta = None if solved.calibration is None else solved.calibration.values
        if trace is not None:
            trace.end_round(why, association, solved)
        return solved

    if start is None and _may_be_by_label(settings, all_rays):
        by_label = associate_by_label(rays)
        solved = solve_round("labels", by_label)
        if _labels_tell(settings, by_label, solved.weight):
            _count_unexplained(rays, by_label, ledger)
            keyframes, rays = _corrected(errors, theta, keyframes, rays)
            return Solution(keyframes, rays, by_label, solved, (), tuple(trace.rounds if trace else ()))

    map_T_camera = keyframes.map_T_camera
    guess: tuple[Association, Floats] | None = None
    if start is None and not keyframes.localized_every:
        start = initialize_unknown(keyframes, rays, cameras, settings, lambda done, total: progress("explore", done, total))
    if start is not None:
        map_T_camera, guess = start.map_T_camera, (start.association, start.positions)
    map_T_base = map_T_camera @ inverse(keyframes.base_T_camera)
    seen, seen_rays, everything = keyframes, rays, (frames, all_rays)
    rounds: list[dict[str, int]] = []
    association: Association | None = None
    estimate: Estimate | None = None
    for number in range(settings.joint.max_rounds):
        progress(f"association, round {number + 1}", 0, 0)
        if errors is not None and theta is not None:
            frames, all_rays = _corrected(errors, theta, *everything)
            keyframes, rays = _corrected(errors, theta, seen, seen_rays)
        at = correct_poses(frames.stamps, frames.map_T_base, keyframes.stamps, keyframes.map_T_base, map_T_base)
        scale = 1.0 if rounds else _FIRST
        noise = np.hypot(all_rays.sigma, scale * _SOLVED_YAW), scale * _SOLVED_XY
        found = _associate(frames, all_rays, cameras, settings, at @ frames.base_T_camera, noise, guess)
        changed = len(rays) if association is None else rays_moved(association.object, found.object)
        rounds.append({"objects": found.count, "rays_changed": changed})
        if changed == 0:
            break
        association = found
        estimate = solve_round("association", association, map_T_base @ keyframes.base_T_camera)
        for _ in range(settings.joint.max_rounds):
            merged = merge_unseen_together(rays, association, estimate, settings.association.duplicate_distance)
            if merged.count == association.count:
                break
            rounds.append({"objects": merged.count, "rays_changed": rays_moved(association.object, merged.object)})
            association = merged
            estimate = solve_round("merge", association, estimate.map_T_base @ keyframes.base_T_camera)
        map_T_base, guess = estimate.map_T_base, (association, estimate.positions)
    else:
        ledger.warn(f"the association still changes after {settings.joint.max_rounds} rounds (joint.max_rounds)")
    assert association is not None
    assert estimate is not None
    _count_unexplained(rays, association, ledger)
    keyframes, rays = _corrected(errors, theta, seen, seen_rays)
    return Solution(keyframes, rays, association, estimate, tuple(rounds), tuple(trace.rounds if trace else ()))


def _corrected(
    errors: SharedErrors | None, theta: Floats | None, keyframes: Keyframes, rays: Rays
) -> tuple[Keyframes, Rays]:
    """Some of the log's keyframes and rays with the shared errors theta (P,) taken out."""
    if errors is None or theta is None:
        return keyframes, rays
    return errors.take(keyframes, rays).at(theta)[:2]


def _associate(
    frames: Keyframes,
    rays: Rays,
    cameras: tuple[Camera, ...],
    settings: Settings,
    map_T_camera: Floats,
    noise: tuple[Floats, float],
    guess: tuple[Association, Floats] | None = None,
) -> Association:
    from objslam.association.global_association import associate_globally

    sigma, place = noise
    return associate_globally(
        rays,
        frames,
        cameras,
        settings,
        map_T_camera=map_T_camera,
        sigma=sigma,
        position_sigma=place,
        seed=settings.seed,
        guess=guess,
    )


def rays_moved(before: Ints, after: Ints) -> int:
    """How many rays (R,) went to another object, whatever numbers the objects have: -1 is no object."""
    from scipy.optimize import linear_sum_assignment

    shared = np.zeros((before.max(initial=-1) + 1, after.max(initial=-1) + 1), dtype=np.int64)
    both = (before >= 0) & (after >= 0)
    np.add.at(shared, (before[both], after[both]), 1)
    stayed = shared[linear_sum_assignment(shared, maximize=True)].sum() + ((before < 0) & (after < 0)).sum()
    return len(before) - int(stayed)


def merge_unseen_together(rays: Rays, association: Association, estimate: Estimate, farthest: float) -> Association:
    """Objects of one label that are no further apart than their covariances allow, and never seen in one frame, are one.

    Poses that drifted between two visits leave one object twice, and each of the two then holds the poses of its visit: no
    association at these poses finds out. Joined, they close the loop. Nearest pairs (by Mahalanobis distance) first; an
    object takes part in one pair at a time.
    """
    position, covariance = estimate.positions, estimate.covariance
    known = np.flatnonzero(np.isfinite(covariance[:, 0, 0]) & np.isfinite(position[:, 0]))
    a, b, apart = near_pairs(position[known], association.label[known], farthest)
    a, b = known[a], known[b]
    squared = np.einsum("pi,pi->p", apart, np.linalg.solve(covariance[a] + covariance[b], apart[..., None])[..., 0])
    order = np.argsort(squared, kind="stable")
    order = order[squared[order] < SAME_POINT]
    held = association.object >= 0
    frames: list[set[int]] = [set() for _ in range(association.count)]
    for j, k in zip(association.object[held].tolist(), rays.keyframe[held].tolist(), strict=True):
        frames[j].add(k)
    into = np.arange(association.count)
    taken = np.zeros(association.count, dtype=bool)
    for i, j in zip(a[order].tolist(), b[order].tolist(), strict=True):
        together = len(frames[i] & frames[j])
        if taken[i] or taken[j] or seen_as_two(together, min(len(frames[i]), len(frames[j]))):
            continue
        keep, drop = (i, j) if len(frames[i]) >= len(frames[j]) else (j, i)
        into[drop], taken[i], taken[j] = keep, True, True
    kept = np.flatnonzero(into == np.arange(association.count))
    number = np.searchsorted(kept, into)
    weights, existence = association.label_weights, association.existence
    return Association(
        object=np.append(number, -1)[association.object],  # -1 takes the last
        label=association.label[kept],
        label_weights=None if weights is None else weights[kept],
        existence=None if existence is None else existence[kept],
    )


def _may_be_by_label(settings: Settings, rays: Rays) -> bool:
    """Whether every label may be one object: as set, or because no frame ever has two boxes of one label."""
    if settings.association.method != "auto":
        return settings.association.method == "by_label"
    pairs = np.stack([rays.keyframe, rays.label])
    return np.unique(pairs, axis=1).shape[1] == pairs.shape[1]


def _labels_tell(settings: Settings, association: Association, weight: Floats) -> bool:
    """Whether the rays bear out that every label is one object: of no label has a large part been rejected (weight 0)."""
    if settings.association.method == "by_label":
        return True
    held = association.object >= 0
    number = np.bincount(association.object[held], minlength=association.count)
    rejected = np.bincount(association.object[held & (weight == 0)], minlength=association.count)
    return not ((rejected >= MANY) & (rejected > SECOND * number)).any()


def _count_unexplained(rays: Rays, association: Association, ledger: Ledger) -> None:
    """Say how many boxes no object explains, where it is more than the usual false boxes, or all of them."""
    left = association.object < 0
    number = np.bincount(rays.label[left], minlength=len(rays.label_names))
    if association.count and left.mean() <= _USUAL:
        return
    worst = ", ".join(f"{rays.label_names[i]} {number[i]}" for i in np.argsort(-number, kind="stable")[:3] if number[i])
    why = "" if association.count else "; an object takes three boxes from three places at least"
    ledger.warn(f"{left.sum()} of {len(left)} boxes are explained by no object at rest ({worst}){why}")
