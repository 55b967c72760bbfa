"""Alternate association and solve until the association is stable. `fixed_poses` is the part for fixed poses."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial
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
from objslam.mapping.checks.unexplained import warn_of_unexplained
from objslam.mapping.fixed_poses import FixedPoses, calibrate_fixed
from objslam.mapping.labels import clock_explains, labels_tell, may_be_by_label, noise_explains, warn_of_noise
from objslam.mapping.progress import Progress

if TYPE_CHECKING:
    from objslam.core.estimate import Estimate
    from objslam.graph.init_unknown_correspondences import InitialEstimate

_SOLVED_XY, _SOLVED_YAW = 0.02, 0.005
"""The noise (m, rad) of solved poses that an association expects. Larger values let it tolerate larger residuals."""
_FIRST = 2.0
"""The factor on `_SOLVED_XY` and `_SOLVED_YAW` before the first solve. A larger factor tolerates larger residuals."""


@dataclass(frozen=True)
class Solution:
    """The association, the estimate, and counts of each round.

    keyframes: the solved keyframes, which have at least one ray. rays: their rays, with indices into these keyframes. trace:
    the rounds for the recording, empty without a recording.
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
    """Find and solve the objects of a log.

    In fixed mode the association runs once, at the given poses, unless the cameras are calibrated against these poses. In
    joint mode the poses are explored first. Then association and solve alternate until no ray changes its object. If the
    settings ask for it, every label is one object instead. The joint mode also tries this if no frame has two boxes of one
    label, and keeps it if the rays agree.

    frames: all keyframes with a pose, also without rays. start: a known start for the keyframes with rays. With it,
    the joint mode neither explores nor trusts labels. errors: the shared errors of the keyframes with rays. They are
    estimated and removed from the keyframes and rays. SolveError if the joint mode has neither odometry nor localisation.
    """
    keyframes, rays_of_keyframes = seen_something(frames, rays)
    trace = Trace(keyframes.base_T_camera) if settings.output.recording else None
    if settings.mode == "fixed":
        at = FixedPoses(frames, rays, keyframes, rays_of_keyframes, cameras, settings)
        if not frames.localized_every:
            cause = " and tell no calibration" if settings.calibration.use is True else ""
            ledger.warn(f"the poses are plain odometry{cause}, so the map drifts with them (--mode joint corrects both)")
        if errors is None:
            progress("association", 0, 0)
            association, rounds = at.associate(), list[dict[str, int]]()
            progress("solve", 0, 0)
            estimate = at.solve(association, trace)
        else:
            at, association, estimate, rounds = calibrate_fixed(at, errors, ledger, progress, trace)
            keyframes, rays_of_keyframes = at.seen, at.rays_seen
    elif not frames.localized_every and frames.odom_T_base is None:
        raise SolveError("the joint mode needs odometry or localisation", hint="give one of them, or use --mode fixed")
    else:
        association, estimate, rounds = _joint(
            frames, rays, keyframes, rays_of_keyframes, cameras, settings, ledger, progress, trace, start, errors
        )
        if errors is not None:
            keyframes, rays_of_keyframes = without_errors(errors, estimate)
    warn_of_unexplained(rays_of_keyframes, association, ledger)
    recorded = tuple(trace.rounds if trace else ())
    return Solution(keyframes, rays_of_keyframes, association, estimate, tuple(rounds), recorded)


def without_errors(errors: SharedErrors, estimate: Estimate) -> tuple[Keyframes, Rays]:
    """Return the keyframes and rays that belong to an estimate: without its shared errors, and with its noise."""
    values = errors.mean if estimate.calibration is None else estimate.calibration.values
    keyframes, rays, _ = with_noise_of(errors, estimate).at(values)
    return keyframes, rays


def with_noise_of(errors: SharedErrors, estimate: Estimate) -> SharedErrors:
    """Return shared errors with the noise of an estimate.

    Lengths keep their measured scale. The shrinkage is corrected only inside a solve.
    """
    noise = errors.noise if estimate.noise is None else estimate.noise
    return errors.with_noise(replace(noise, shrinkage=0.0))


def seen_something(keyframes: Keyframes, rays: Rays) -> tuple[Keyframes, Rays]:
    """Return the keyframes that have a ray, and the rays with indices into them. Other poses depend on odometry only."""
    kept, keyframe = np.unique(rays.keyframe, return_inverse=True)
    return keyframes.take(kept), replace(rays, keyframe=keyframe.astype(np.int64))


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
) -> tuple[Association, Estimate, list[dict[str, int]]]:
    from objslam.graph import batch_solver

    theta: Floats | None = None
    measured = frames, all_rays

    def solve_once(
        association: Association,
        errors: SharedErrors | None,
        start: Floats | None = None,
        trace: Trace | None = None,
        begin: Floats | None = None,
        hold: bool = False,
    ) -> Estimate:
        at = theta if begin is None else begin
        given = keyframes, rays, association, settings, ledger, partial(progress, "solve")
        return batch_solver.solve_joint(*given, start, trace, errors, at, hold)

    def solve_round(why: Why, association: Association, start: Floats | None = None, hold: bool = False) -> Estimate:
        nonlocal theta, errors, keyframes, rays
        solved = solve_once(association, errors, start, trace, hold=hold)
        if errors is not None and solved.noise is not None:
            errors = errors.with_noise(solved.noise)
            theta = solved.calibration.values if solved.calibration is not None else errors.mean
            keyframes, rays = without_errors(errors, solved)
        if trace is not None:
            trace.end_round(why, association, solved)
        return solved

    rounds: list[dict[str, int]] = []

    def merge(association: Association, estimate: Estimate, hold: bool) -> tuple[Association, Estimate]:
        for _ in range(settings.joint.max_rounds):
            merged = merge_unseen_together(rays, association, estimate, settings.association.duplicate_distance)
            if merged.count == association.count:
                break
            rounds.append({"objects": merged.count, "rays_changed": rays_moved(association.object, merged.object)})
            association = merged
            estimate = solve_round("merge", association, estimate.map_T_base @ keyframes.base_T_camera, hold)
        return association, estimate

    if start is None and may_be_by_label(settings, all_rays):
        by_label, expected = associate_by_label(rays), errors
        solved = solve_round("labels", by_label)
        if settings.association.method == "by_label" or labels_tell(by_label, solved):
            return by_label, solved, []
        noisier = None if errors is None else noise_explains(by_label, solved, errors, partial(solve_once, by_label))
        if errors is not None and noisier is not None:
            warn_of_noise(errors, noisier, ledger)
            return by_label, solve_round("labels", by_label, noisier.map_T_base @ keyframes.base_T_camera), []
        if expected is not None:
            begin = clock_explains(by_label, expected, lambda at: solve_once(by_label, expected, begin=at))
            if begin is not None:
                errors, theta = expected, begin
                return by_label, solve_round("labels", by_label), []

    map_T_camera = keyframes.map_T_camera
    guess: tuple[Association, Floats] | None = None
    estimate: Estimate | None = None
    hold = False  # whether the shared errors are known well enough to move only in the last solve
    if start is None and not keyframes.localized_every:
        from objslam.graph import ekf_exploration
        from objslam.graph.init_unknown_correspondences import initialize_unknown

        exploring = partial(progress, "explore")
        if np.isfinite(rays.range).any():
            start = ekf_exploration.explore(keyframes, rays, settings, exploring, errors)
        if start is not None and ekf_exploration.is_sure(start):
            estimate = solve_round("association", start.association)
            poses = estimate.map_T_base @ keyframes.base_T_camera
            start, hold = replace(start, map_T_camera=poses, positions=estimate.positions), True
        else:
            start = initialize_unknown(keyframes, rays, cameras, settings, exploring)
    if start is not None:
        map_T_camera, guess = start.map_T_camera, (start.association, start.positions)
    map_T_base = map_T_camera @ inverse(keyframes.base_T_camera)
    association: Association | None = None
    for number in range(settings.joint.max_rounds):
        progress(f"association, round {number + 1}", 0, 0)
        if errors is not None and theta is not None:
            frames, all_rays, _ = errors.take(*measured).at(theta, drift=False)
            # If the estimated noise is below the nominal noise, it describes inliers only. The gate needs the larger one.
            all_rays = replace(all_rays, sigma=np.maximum(all_rays.sigma, measured[1].sigma))
        at = correct_poses(frames.stamps, frames.map_T_base, keyframes.stamps, keyframes.map_T_base, map_T_base)
        scale = 1.0 if rounds else _FIRST
        noise = np.hypot(all_rays.sigma, scale * _SOLVED_YAW), scale * _SOLVED_XY
        found = _associate(frames, all_rays, cameras, settings, at @ frames.base_T_camera, noise, guess)
        changed = len(rays) if association is None else rays_moved(association.object, found.object)
        rounds.append({"objects": found.count, "rays_changed": changed})
        if changed == 0:
            break
        association = found
        estimate = solve_round("association", association, map_T_base @ keyframes.base_T_camera, hold)
        association, estimate = merge(association, estimate, hold)
        map_T_base, guess = estimate.map_T_base, (association, estimate.positions)
    else:
        ledger.warn(f"the association still changes after {settings.joint.max_rounds} rounds (joint.max_rounds)")
    assert association is not None
    if hold:  # The covariances now contain the shared errors, so that more pairs may be one object.
        estimate = solve_round("association", association, map_T_base @ keyframes.base_T_camera)
        association, estimate = merge(association, estimate, hold=False)
    assert estimate is not None
    return association, estimate, rounds


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
    """Return how many rays (R,) changed their object. Renumbered objects count as the same. -1 means no object."""
    from scipy.optimize import linear_sum_assignment

    shared = np.zeros((before.max(initial=-1) + 1, after.max(initial=-1) + 1), dtype=np.int64)
    both = (before >= 0) & (after >= 0)
    np.add.at(shared, (before[both], after[both]), 1)
    stayed = shared[linear_sum_assignment(shared, maximize=True)].sum() + ((before < 0) & (after < 0)).sum()
    return len(before) - int(stayed)


def merge_unseen_together(rays: Rays, association: Association, estimate: Estimate, farthest: float) -> Association:
    """Merge pairs of objects of one label whose positions agree within their covariances, and that share no frame.

    If poses drift between two visits, an object appears twice. Each copy keeps the poses of its visit where they are. So an
    association at these poses cannot find the error, but a merge closes the loop. The nearest pairs by Mahalanobis distance
    merge first. An object takes part in one merge at a time. farthest: the largest distance (m) of a pair.
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
        object=np.append(number, -1)[association.object],  # -1 indexes the last
        label=association.label[kept],
        label_weights=None if weights is None else weights[kept],
        existence=None if existence is None else existence[kept],
    )
