"""Association and solve: once where the poses are known, in turns where they move each other."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from objslam.association.by_label import associate_by_label
from objslam.config import Settings
from objslam.errors import SolveError
from objslam.keyframes import correct_poses
from objslam.ledger import Ledger
from objslam.types import Association, Camera, Floats, Keyframes, Rays

if TYPE_CHECKING:
    from objslam.graph.batch import Estimate

# What solved poses still err by, seen from the objects: with it an association at them is neither too sure nor too tolerant.
_SOLVED_XY = 0.02  # m
_SOLVED_YAW = 0.005  # rad
_FIRST = 2.0  # times that, before the first solve

Progress = Callable[[str, int, int], None]
"""Called with the stage's name, what is done and the total (0 when it is not known)."""


@dataclass(frozen=True)
class Solution:
    """Which ray belongs to which object, the estimate, and what each round of the two did.

    rays, keyframes: those that were solved, the keyframes without a ray left out; rays.keyframe counts in them.
    """

    keyframes: Keyframes
    rays: Rays
    association: Association
    estimate: Estimate
    rounds: tuple[dict[str, int], ...]


def solve(
    frames: Keyframes,
    rays: Rays,
    cameras: tuple[Camera, ...],
    settings: Settings,
    ledger: Ledger,
    progress: Progress,
) -> Solution:
    """Find and solve the objects of a log; frames are all that have a pose, those without a ray too.

    Fixed mode: one association at the poses as they are, one solve. Joint mode: where every label is one object, the graph
    grows with that knowledge; else the poses are explored without it, then association and joint solve take turns until no
    ray changes its object. SolveError where joint mode has neither odometry nor localisation.
    """
    from objslam.graph import batch

    keyframes, rays_of_keyframes = seen_something(frames, rays)
    if settings.mode == "fixed":
        if not frames.localized_every:
            ledger.warn("the poses are odometry, taken as they are: the map drifts as they do (--mode joint corrects both)")
        progress("association", 0, 0)
        association = _associate(
            frames, rays, cameras, settings, frames.map_T_camera, batch.pose_noise(rays, frames, settings)
        )
        progress("solve", 0, 0)
        placed = batch.triangulate_at(keyframes.map_T_camera, keyframes, rays_of_keyframes, association, settings)
        estimate = batch.solve_fixed(keyframes, rays_of_keyframes, association, placed, settings)
        _count_unexplained(association, ledger)
        return Solution(keyframes, rays_of_keyframes, association, estimate, ())
    if not frames.localized_every and frames.odom_T_base is None:
        raise SolveError("the joint mode needs odometry or localisation")
    return _joint(frames, rays, keyframes, rays_of_keyframes, cameras, settings, ledger, progress)


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
) -> Solution:
    from objslam.graph import batch
    from objslam.graph.explore import explore

    def tell(done: int, total: int) -> None:
        progress("solve", done, total)

    if _by_label(settings, all_rays):
        association = associate_by_label(rays)
        estimate = batch.solve_joint(keyframes, rays, association, settings, ledger, tell)
        _count_unexplained(association, ledger)
        return Solution(keyframes, rays, association, estimate, ())

    map_T_camera = keyframes.map_T_camera
    if not keyframes.localized_every:
        map_T_camera = explore(keyframes, rays, cameras, settings, lambda done, total: progress("explore", done, total))
    map_T_base = map_T_camera @ np.linalg.inv(keyframes.base_T_camera)
    rounds: list[dict[str, int]] = []
    association: Association | None = None
    estimate: Estimate | None = None
    for number in range(settings.joint.max_rounds):
        progress(f"association, round {number + 1}", 0, 0)
        at = correct_poses(frames.stamps, frames.map_T_base, keyframes.stamps, keyframes.map_T_base, map_T_base)
        scale = 1.0 if rounds else _FIRST
        noise = np.hypot(all_rays.sigma, scale * _SOLVED_YAW), scale * _SOLVED_XY
        found = _associate(frames, all_rays, cameras, settings, at @ frames.base_T_camera, noise)
        changed = len(rays) if association is None else int((found.object != association.object).sum())
        rounds.append({"objects": found.count, "rays_changed": changed})
        if changed == 0:
            break
        association = found
        start = map_T_base @ keyframes.base_T_camera
        estimate = batch.solve_joint(keyframes, rays, association, settings, ledger, tell, start)
        map_T_base = estimate.map_T_base
    else:
        ledger.warn(f"the association still changes after {settings.joint.max_rounds} rounds (joint.max_rounds)")
    assert association is not None
    assert estimate is not None
    _count_unexplained(association, ledger)
    return Solution(keyframes, rays, association, estimate, tuple(rounds))


def _associate(
    frames: Keyframes,
    rays: Rays,
    cameras: tuple[Camera, ...],
    settings: Settings,
    map_T_camera: Floats,
    noise: tuple[Floats, float],
) -> Association:
    if settings.association.method == "by_label":
        return associate_by_label(rays)
    from objslam.association.search import associate

    sigma, place = noise
    return associate(
        rays, frames, cameras, settings, map_T_camera=map_T_camera, sigma=sigma, position_sigma=place, seed=settings.seed
    )


def _by_label(settings: Settings, rays: Rays) -> bool:
    """Whether labels tell objects apart: as set, or because no frame ever has two boxes of one label."""
    if settings.association.method != "auto":
        return settings.association.method == "by_label"
    pairs = np.stack([rays.keyframe, rays.label])
    return np.unique(pairs, axis=1).shape[1] == pairs.shape[1]


def _count_unexplained(association: Association, ledger: Ledger) -> None:
    ledger.drop("boxes that no object at rest explains", int((association.object < 0).sum()))
