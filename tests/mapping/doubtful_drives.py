"""Simulated drives with one thing wrong in each, and results with objects that were merged or split on purpose."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
from quick import NOTHING_DRAWN

from objslam.config import Settings, load_settings
from objslam.core.arrays import Bools, Floats, Ints
from objslam.core.camera import project
from objslam.core.diagnostics import Ledger
from objslam.core.estimate import Estimate
from objslam.core.geometry import inverse
from objslam.core.result import RunResult
from objslam.core.types import Association, Log
from objslam.frontend.keyframes import build_keyframes
from objslam.graph.fixed_pose_triangulation import triangulate_at
from objslam.mapping.describe import describe, make_result
from objslam.mapping.pipeline import run
from objslam.mapping.solution import Solution
from objslam.simulation import preset, simulate

DEFAULT = load_settings(None, NOTHING_DRAWN)
LEAN = load_settings(None, (*NOTHING_DRAWN, "checks.use=false", "bodies.use=false"))
"""Without a look at the input, and without bodies. No doubt comes from these."""


def mapped(log: Log, settings: Settings = LEAN) -> RunResult:
    """The result of a run."""
    return run(log, settings, Ledger())


@cache
def clean_rooms(tracks: str | None = None) -> RunResult:
    """The result of a drive without false boxes. tracks: as in `DriveSettings`, None for those of the preset."""
    return mapped(simulate(preset("rooms", false=0.0, **({} if tracks is None else {"tracks": tracks})), 4))


def camera_poses(log: Log) -> Floats:
    """(F, 4, 4) map_T_camera of each frame of the first camera, which must all have a pose."""
    frames = build_keyframes(log, LEAN, Ledger())
    assert len(frames) == len(log.cameras[0].detections.frame_stamps)
    return frames.map_T_camera


def boxes_of(log: Log, places: Floats, size: float) -> tuple[Ints, Floats]:
    """The frames (n,) in which a thing at places (F, 3) is in the image within 5 m, and its boxes (n, 4)."""
    camera, poses = log.cameras[0].camera, camera_poses(log)
    local = np.einsum("fij,fj->fi", inverse(poses)[:, :3, :3], places - poses[:, :3, 3])
    frames = np.flatnonzero((local[:, 2] > 0.4) & (local[:, 2] < 5.0))
    pixel, half = project(camera, local[frames]), camera.focal * size / local[frames, 2, None] / 2
    inside = ((pixel - half > 0) & (pixel + half < camera.size - 1)).all(axis=1)
    return frames[inside], np.hstack([pixel - half, pixel + half])[inside]


def relabelled(log: Log, which: Bools, label: str) -> Log:
    """The log with another label for a share of its boxes. which: (M,)."""
    found = log.cameras[0].detections
    names = (*found.label_names, label)
    changed = replace(found, label=np.where(which, len(names) - 1, found.label), label_names=names)
    return replace(log, cameras=(replace(log.cameras[0], detections=changed),))


def reassociated(result: RunResult, object_: Ints) -> RunResult:
    """The result of a fixed run with other objects: the object of each ray (R,), or -1, placed anew by Eq. 1."""
    first = np.array([result.rays.label[object_ == j][0] for j in range(object_.max() + 1)])
    association = Association(object_, first, existence=np.ones(len(first)))
    keyframes, poses = result.keyframes, result.keyframes.map_T_camera
    placed = triangulate_at(poses, keyframes, result.rays, association, result.settings)
    sigma = np.sqrt(np.linalg.eigvalsh(placed.covariance)[:, -1])
    estimate = Estimate(
        keyframes.map_T_base, placed.positions, placed.covariance, sigma, placed.ok, placed.weight, 0.0, 0.0, 0
    )
    solution = Solution(keyframes, result.rays, association, estimate, ())
    objects, residual = describe(solution, result.cameras, result.settings)
    more = {"cameras": result.cameras, "path": result.path, "path_after": result.path_after, "views": result.views}
    return make_result(solution, objects, residual, {**result.summary}, result.settings, **more)
