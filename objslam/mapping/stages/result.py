"""The last stages of a run: find the drive in an older map, correct its path, and put the result together."""

from dataclasses import replace
from typing import Any

import numpy as np

from objslam.config import Settings
from objslam.core.arrays import Floats
from objslam.core.diagnostics import Ledger
from objslam.core.geometry import interpolate
from objslam.core.result import RunResult, Surface
from objslam.core.trajectory import Trajectory, correct_path
from objslam.core.types import Keyframes, Log
from objslam.frontend.keyframes import with_given_stamps
from objslam.mapping.describe import make_result, summarise
from objslam.mapping.localization import Localization, PriorMap, describe_in_map, localize, moved_log
from objslam.mapping.progress import Progress, stage
from objslam.mapping.stages.described import DescribedDrive
from objslam.mapping.uncorrected import uncorrected_residual
from objslam.mapping.views import solved_views


def in_known_map(of: DescribedDrive, known: PriorMap, ledger: Ledger) -> tuple[DescribedDrive, Localization]:
    """Return the drive in the frame of an older map, if the drive is found in this map.

    Otherwise the drive stays in its own frame, and the ledger gets a warning with the reason.
    """
    found, drive = of.found, of.found.drive
    where = localize(found.solution, of.objects, known, found.errors, drive.settings, ledger)
    if where.solution is None or where.map_T_drive is None:
        return of, where
    ids = [item.id for item in of.objects.objects]
    solution, objects, residual = describe_in_map(where, known, drive.cameras, drive.settings, ids, trusted=of.trusted)
    moved = replace(drive, log=moved_log(drive.log, where.map_T_drive))
    return replace(of, found=replace(found, drive=moved, solution=solution), objects=objects, residual=residual), where


def in_map(where: Localization | None) -> dict[str, Any]:
    """Return the entries of the summary about the place of a drive in an older map. where: None if there is no such map."""
    if where is None:
        return {}
    return {"localisation": where.told, **({} if where.solution is None else {"map_frame": "map"})}


def result_of(
    of: DescribedDrive,
    where: Localization | None,
    frames: Keyframes,
    seconds: dict[str, float],
    ledger: Ledger,
    progress: Progress,
) -> RunResult:
    """Return the result of a described drive.

    where: the place of the drive in an older map, None if there is no such map. frames: all frames on the path. seconds: the
    times (s) of the stages so far. The reconstruction, if any, adds its time.
    """
    drive, solution, errors = of.found.drive, of.found.solution, of.found.errors
    log, settings, given = drive.log, drive.settings, drive.given
    path = log.robot_path
    assert path is not None  # Without a path, build_keyframes raises LogError.
    path_after = _path_after(log, path, solution.keyframes, solution.estimate.map_T_base, settings)
    residual_before = None if errors is None else uncorrected_residual(errors, solution, path_after)
    surface, surface_before = _surfaces(log, path, path_after, settings, seconds, ledger, progress)
    counts = {
        "images": sum(len(c.rgb.paths) for c in log.cameras if c.rgb is not None),
        "detection_frames": drive.frames,
        "frames_on_path": len(frames),
        "detections": drive.detections,
    }
    return make_result(
        replace(solution, keyframes=with_given_stamps(solution.keyframes, given)),
        of.objects,
        of.residual,
        summary={
            **summarise(log.name, log.path, counts, settings, ledger, solution, of.objects, seconds),
            "part": dict(zip(("begin", "end"), log.part, strict=True)),
            "odometry_clock": None if drive.clock is None else drive.clock.to_dict(),
            "odometry_unused": drive.chosen and drive.both and not drive.joint,
            "wrong_input": [finding.to_dict() for finding in drive.diagnosis.findings],
            **in_map(where),
        },
        settings=settings,
        cameras=drive.cameras,
        path=path,
        path_after=path_after,
        images=tuple(c.rgb for c in log.cameras),
        surface=surface,
        surface_before=surface_before,
        residual_before=residual_before,
        views=with_given_stamps(solved_views(log, settings, path_after), given),
    )


def _surfaces(
    log: Log,
    path: Trajectory,
    path_after: Trajectory,
    settings: Settings,
    seconds: dict[str, float],
    ledger: Ledger,
    progress: Progress,
) -> tuple[Surface | None, Surface | None]:
    """Return the surface at the solved path, and the surface at the given path if the settings ask for it. A surface that is
    not made is None."""
    if not settings.reconstruction.use or all(c.depth is None for c in log.cameras):
        return None, None
    from objslam.mapping.reconstruction import reconstruct  # Few logs have depth images.

    with stage("reconstruction", seconds, progress):
        after = reconstruct(log, path_after, settings, ledger, progress)
        if not settings.reconstruction.before:
            return after, None
        return after, reconstruct(log, path, settings, Ledger(), progress)  # The first call counted the drops.


def _path_after(log: Log, path: Trajectory, keyframes: Keyframes, map_T_base: Floats, settings: Settings) -> Trajectory:
    """Return the path through the solved poses (K, 4, 4). In joint mode, the path follows the odometry between keyframes."""
    # Between two keyframes, the path follows the odometry. The localisation would bring back its jitter.
    after = correct_path(path, keyframes.stamps, keyframes.map_T_base, map_T_base)
    way = log.odometry
    if settings.mode == "fixed" or way is None or way is path:
        return after
    before, _ = interpolate(way.stamps, way.poses, np.clip(keyframes.stamps, way.stamps[0], way.stamps[-1]), float("inf"))
    smooth = correct_path(way, keyframes.stamps, before, map_T_base)
    poses, inside = interpolate(way.stamps, smooth.poses, path.stamps, settings.poses.max_gap)
    return Trajectory(path.stamps, np.where(inside[:, None, None], poses, after.poses))
