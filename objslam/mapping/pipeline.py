"""Run the offline mapping: turn a whole log into a map of objects."""

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace

import numpy as np

from objslam.config import Settings
from objslam.core.arrays import Floats
from objslam.core.diagnostics import Ledger
from objslam.core.geometry import interpolate
from objslam.core.result import RunResult
from objslam.core.trajectory import correct_path
from objslam.core.types import Keyframes, Log, Trajectory
from objslam.errors import LogError, SolveError
from objslam.frontend.bearings import build_rays
from objslam.frontend.keyframes import build_keyframes
from objslam.frontend.shared_errors import shared_errors
from objslam.mapping.alternation import Progress, seen_something, solve
from objslam.mapping.describe import describe, summarise
from objslam.mapping.plausibility import warn_of_large_errors
from objslam.mapping.reconstruction import reconstruct


def run(log: Log, settings: Settings, ledger: Ledger, progress: Progress = lambda stage, done, total: None) -> RunResult:
    """Map the objects of a log. The ledger counts dropped data, and the summary of the result repeats these counts.

    LogError if no frame lies on the path. SolveError if no box gives a usable ray.
    """
    log = _chosen_poses(log, settings)
    seconds: dict[str, float] = {}
    with _stage("rays", seconds, progress):
        frames = build_keyframes(log, settings, ledger)
        rays = build_rays(log, frames, settings, ledger)
    if len(rays) == 0:
        raise SolveError(
            "no box gives a usable ray", where=log.name, hint="; ".join(ledger.lines()) or "the detections are empty"
        )
    cameras = tuple(c.camera for c in log.cameras)
    with _stage("solve", seconds, progress):
        errors = shared_errors(log, *seen_something(frames, rays), settings)
        solution = solve(frames, rays, cameras, settings, ledger, progress, errors=errors)
    keyframes, rays, estimate = solution.keyframes, solution.rays, solution.estimate
    if errors is not None and estimate.calibration is not None:
        log = errors.corrected_log(estimate.calibration.values)
        cameras = tuple(c.camera for c in log.cameras)
        warn_of_large_errors(estimate.calibration, ledger)
    objects, residual = describe(solution, cameras, settings)
    origins, directions = rays.in_map(estimate.map_T_base @ keyframes.base_T_camera)
    path = log.localization or log.odometry
    assert path is not None  # build_keyframes raises LogError otherwise
    path_after = _path_after(log, path, keyframes, estimate.map_T_base, settings)
    surface, before = None, None
    if settings.reconstruction.use and any(c.depth is not None for c in log.cameras):
        with _stage("reconstruction", seconds, progress):
            surface = reconstruct(log, path_after, settings, ledger, progress)
            if settings.reconstruction.before:
                before = reconstruct(log, path, settings, Ledger(), progress)  # the ledger has its drops already
    found = [c.detections for c in log.cameras if c.detections is not None]
    counts = {
        "images": sum(len(c.rgb.paths) for c in log.cameras if c.rgb is not None),
        "detection_frames": sum(len(detections.frame_stamps) for detections in found),
        "frames_on_path": len(frames),
        "detections": sum(len(detections) for detections in found),
    }
    return RunResult(
        map=objects,
        keyframes=keyframes,
        map_T_base=estimate.map_T_base,
        rays=rays,
        association=solution.association,
        origins=origins,
        directions=directions,
        residual=residual,
        weight=estimate.weight,
        summary=summarise(log.name, log.path, counts, settings, ledger, solution, objects, seconds),
        settings=settings,
        cameras=cameras,
        path=path,
        path_after=path_after,
        trace=solution.trace,
        images=tuple(c.rgb for c in log.cameras),
        surface=surface,
        surface_before=before,
        calibration=estimate.calibration,
    )


def _path_after(log: Log, path: Trajectory, keyframes: Keyframes, map_T_base: Floats, settings: Settings) -> Trajectory:
    """Return the path through the solved poses (K, 4, 4). In joint mode it follows the odometry between keyframes."""
    # The localisation between two keyframes would bring back its jitter.
    after = correct_path(path, keyframes.stamps, keyframes.map_T_base, map_T_base)
    way = log.odometry
    if settings.mode == "fixed" or way is None or way is path:
        return after
    before, _ = interpolate(way.stamps, way.poses, np.clip(keyframes.stamps, way.stamps[0], way.stamps[-1]), float("inf"))
    smooth = correct_path(way, keyframes.stamps, before, map_T_base)
    poses, inside = interpolate(way.stamps, smooth.poses, path.stamps, settings.poses.max_gap)
    return Trajectory(path.stamps, np.where(inside[:, None, None], poses, after.poses))


def _chosen_poses(log: Log, settings: Settings) -> Log:
    use = settings.poses.use
    if use == "auto":
        return log
    if (log.odometry if use == "odometry" else log.localization) is None:
        raise LogError(f"the log has no {use}", where=log.name, hint="set poses.use to auto")
    return replace(log, localization=None) if use == "odometry" else replace(log, odometry=None)


@contextmanager
def _stage(name: str, seconds: dict[str, float], progress: Progress) -> Iterator[None]:
    progress(name, 0, 0)
    begin = time.perf_counter()
    yield
    seconds[name] = round(time.perf_counter() - begin, 4)
