"""Write the files of a result folder, clear the folder, and replace an older result by a new one."""

import json
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from objslam.config import dump_settings
from objslam.core.result import RunResult
from objslam.core.trajectory import Trajectory, rates
from objslam.core.types import CameraLog, Truth
from objslam.errors import OutputError
from objslam.evaluation.alignment import lay_truth
from objslam.io.atomic_files import FileSet, disk_errors, encode, is_cut_short, is_locked, replace_files, try_folder
from objslam.io.detections_jsonl import write_detections
from objslam.io.folders import no_empty_folders
from objslam.io.objects_json import dump_objects, dump_truth_objects
from objslam.io.odometry_parquet import dump_motions
from objslam.io.ply import write_cloud, write_mesh
from objslam.io.rays_parquet import RayFeatures, RaysTable, dump_features, dump_rays
from objslam.io.results import files
from objslam.io.results.files import dump_doubts, dump_json
from objslam.io.results.read import load_map
from objslam.io.tum_trajectory import write_trajectory
from objslam.io.views_parquet import Views, dump_views
from objslam.mapping.measured_motions import motions_of
from objslam.output.export.formats import FORMATS
from objslam.sources.journal.record_format import NAME
from objslam.sources.log_folder import resembles_log

RESULT_FILES = FileSet(files.SUMMARY, (*files.PARTS, *(known.file for known in FORMATS.values())), f"*.{files.DETECTIONS}")
"""The files that a new result replaces or deletes, including the exports of the older result."""
_ALL_BUT_OBJECTS = replace(RESULT_FILES, others=tuple(name for name in RESULT_FILES.others if name != files.OBJECTS))
"""The files of an older result that a live session deletes: all files except objects.json, which the session replaces."""


def prepare_output(out: Path) -> None:
    """Make the folder for a result and write a test file to it. Call this function before a long computation.

    Raises:
        OutputError: the folder cannot be written, or the result would replace files that no run wrote: files of a log, files
            of a ground truth, or foreign files with the name of a result file.
    """
    with disk_errors(out):
        if out.exists() and not out.is_dir():
            raise OutputError("the output is a file, not a folder", where=str(out), hint="name a folder with -o")
        if resembles_log(out):
            hint = "name another folder with -o"
            raise OutputError("this is a log, and a result needs a folder of its own", where=str(out), hint=hint)
        names = _existing_files(out)
        if names and not is_cut_short(out, RESULT_FILES) and not _is_result(out, names):
            what = f"these files are in the way of a result and were not written by a run: {', '.join(names)}"
            raise OutputError(what, where=str(out), hint="name another folder with -o, or move these files")
        for name in RESULT_FILES.names(out):
            if (out / name).is_dir() and not (out / name).is_symlink():
                what = "a file of the result cannot be written, because a folder has its name: move the folder"
                raise OutputError(what, where=str(out / name))
    try_folder(out, RESULT_FILES)


def foreign_files(out: Path) -> list[str]:
    """Return the sorted names of the files and folders in `out` that are not files of a result, without hidden ones.

    The list is empty if `out` already has a result. The files of a new result would be written beside these files.
    """
    if not out.is_dir() or (out / files.SUMMARY).is_file() or (out / files.OBJECTS).is_file():
        return []
    return sorted({one.name for one in out.iterdir() if not one.name.startswith(".")} - set(RESULT_FILES.names(out)))


@contextmanager
def output_folder(out: Path) -> Iterator[None]:
    """Call `prepare_output`, then run the `with` block. If the block fails, delete the new folder if it is empty.

    Raises:
        OutputError: the errors of `prepare_output`, or a live session writes into the folder.
    """
    with no_empty_folders(out):
        refuse_session(out)
        prepare_output(out)
        yield


def refuse_session(out: Path) -> None:
    """Raise OutputError if a running session has its journal in `out`. Its result would replace a new result there."""
    file = out / NAME
    with disk_errors(out):
        if is_locked(file):
            raise OutputError("a live session writes here", where=str(file), hint="name another folder with -o, or end it")


def write_result(
    result: RunResult, out: Path, truth: Truth | None = None, *, detected: tuple[CameraLog, ...] = ()
) -> tuple[str, ...]:
    """Write a result into the folder `out` and replace an older result there. Other files stay.

    A run that is killed leaves no partial file and no mix of two results. summary.json exists only if all other
    files of its result exist.

    Args:
        truth: the ground truth. It is stored so that `load_truth` can read it, and it is drawn in the frame of the map.
        detected: the cameras whose boxes this run detected. The boxes are stored as detections.jsonl, which a log can use.
            With several cameras, the file name starts with the camera's name.
    Returns:
        The names of the older result's files that were deleted and not replaced, such as an export or a report.
    Raises:
        OutputError: the folder cannot be written, or another run writes there.
    """
    prepare_output(out)
    return replace_files(out, RESULT_FILES, _writers(result, truth, detected))


def copy_result(folder: Path, out: Path) -> tuple[str, ...]:
    """Copy the files of the result in `folder` into `out`, and replace an older result there.

    The returned names and the errors are those of `write_result`.
    """
    prepare_output(out)
    found = [name for name in RESULT_FILES.names(folder) if (folder / name).is_file()]
    return replace_files(out, RESULT_FILES, {name: partial(shutil.copyfile, folder / name) for name in found})


def clear_result(out: Path) -> tuple[str, ...]:
    """Delete the files of an earlier run from the folder of a live session, and return their names.

    A remaining file would look like a file of the session. objects.json stays, because the session replaces it. If the
    process is killed here, the next `prepare_output` deletes the rest. Raises the same OutputError as `write_result`.
    """
    return replace_files(out, _ALL_BUT_OBJECTS, {})


def _writers(result: RunResult, truth: Truth | None, detected: tuple[CameraLog, ...]) -> dict[str, Callable[[Path], object]]:
    """Return, for each file name of a result, the function that writes this file."""
    stamps, first = np.unique(result.keyframes.stamps, return_index=True)
    writers: dict[str, Callable[[Path], object]] = {
        files.OBJECTS: lambda file: file.write_bytes(encode(dump_objects(result.map))),
        files.TRAJECTORY: partial(write_trajectory, Trajectory(stamps, result.map_T_base[first])),
        files.PATH: partial(write_trajectory, result.path_after),
        files.RAYS: lambda file: file.write_bytes(dump_rays(rays_table(result))),
        files.CONFIG: lambda file: file.write_bytes(encode(dump_settings(result.settings))),
        files.DOUBTS: lambda file: file.write_bytes(encode(dump_doubts(result.doubts))),
        files.SUMMARY: lambda file: file.write_bytes(encode(dump_json(result.summary))),
    }
    index, table = result.rays.feature, result.rays.feature_table
    if index is not None and table is not None:
        known = np.flatnonzero(index >= 0)
        features = RayFeatures(known, table.vectors[index[known]])
        writers[files.FEATURES] = lambda file: file.write_bytes(dump_features(features))
    motions = motions_of(result)
    if motions is not None:
        writers[files.MOTIONS] = lambda file: file.write_bytes(dump_motions(motions))
    if result.views is not None:
        views = Views.of(result.views, result.cameras, result.settings)
        writers[files.VIEWS] = lambda file: file.write_bytes(dump_views(views))
    if truth is not None and truth.objects:
        objects = truth.objects
        writers[files.TRUTH_OBJECTS] = lambda file: file.write_bytes(encode(dump_truth_objects(objects)))
    if truth is not None and truth.trajectory is not None:
        writers[files.TRUTH_TRAJECTORY] = partial(write_trajectory, truth.trajectory)
    for camera_log in detected:
        if camera_log.detections is not None:
            name = files.DETECTIONS if len(detected) == 1 else f"{camera_log.camera.name}.{files.DETECTIONS}"
            writers[name] = partial(write_detections, camera_log.detections)
    if result.surface is not None:
        writers[files.SURFACE] = partial(write_mesh, result.surface)
        if result.settings.reconstruction.cloud:
            writers[files.CLOUD] = partial(write_cloud, result.surface)
    if result.surface_before is not None:
        writers[files.SURFACE_BEFORE] = partial(write_mesh, result.surface_before)
    drawn = lay_truth(result.map, truth) if truth is not None else None
    if result.settings.output.picture:
        from objslam.output.plot.map_plot import draw_map

        writers[files.PICTURE] = lambda file: draw_map(result, file, drawn)
    if result.settings.output.recording:
        from objslam.output.viewer.recording import write_recording

        writers[files.RECORDING] = lambda file: write_recording(result, file, drawn)
    return writers


def rays_table(result: RunResult) -> RaysTable:
    """Return the content of rays.parquet. Each ray has the id of its object in objects.json, or -1 without an object."""
    rays, keyframes = result.rays, result.keyframes
    ids = np.array([*(o.id for o in result.map.objects), -1], dtype=np.int64)
    cameras = np.array([camera.name for camera in result.cameras], dtype=object)
    sizes = np.array([(camera.width, camera.height) for camera in result.cameras], dtype=np.float64).reshape(-1, 2)
    speed, turn_rate = rates(result.path_after, keyframes.stamps)
    before = result.residual_before
    return RaysTable(
        object=ids[result.association.object],
        stamp=keyframes.stamps[rays.keyframe],
        frame_stamp=keyframes.frame_stamps[rays.keyframe],
        origin=result.origins,
        direction=result.directions,
        residual=result.residual,
        weight=result.weight,
        score=rays.score,
        camera=cameras[keyframes.camera[rays.keyframe]],
        box=rays.box,
        label=np.array(rays.label_names, dtype=object)[rays.label],
        sigma=rays.sigma,
        residual_before=np.full(len(rays), np.nan) if before is None else before,
        image=(rays.box[:, :2] + rays.box[:, 2:]) / 2 / sizes[keyframes.camera[rays.keyframe]],
        speed=speed[rays.keyframe],
        turn_rate=turn_rate[rays.keyframe],
    )


def _existing_files(out: Path) -> list[str]:
    return [name for name in RESULT_FILES.names(out) if (out / name).is_file()]


def _is_result(out: Path, names: list[str]) -> bool:
    """Return whether these files belong to a result, or to a live session that has not ended."""
    if out.resolve().name == files.GROUNDTRUTH:
        return False
    try:
        load_map(out)
        return names == [files.OBJECTS] or isinstance(json.loads((out / files.SUMMARY).read_bytes()), dict)
    except (OutputError, OSError, ValueError):
        return False
