"""The result of a run, and what of it is on disk: which files, what writes them and reads them back."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from objslam.atomic_files import FileSet, disk_errors, encode, has_staging, is_cut_short, replace_files, try_folder
from objslam.config import Settings, dump_settings
from objslam.errors import LogError, OutputError
from objslam.folders import no_empty_folders
from objslam.ledger import Ledger
from objslam.matching import lay_truth
from objslam.motions_file import Motions, dump_motions, motions_of, read_motions
from objslam.objects_file import dump_objects, dump_truth_objects, read_objects, read_truth_objects
from objslam.ply_file import write_cloud, write_mesh
from objslam.rays_file import RaysTable, dump_rays, read_rays
from objslam.sources.detections_file import write_detections
from objslam.sources.folder import resembles_log
from objslam.sources.trajectory_file import read_trajectory, write_trajectory
from objslam.trace import Round
from objslam.types import (
    Association,
    Camera,
    CameraLog,
    Floats,
    Images,
    Keyframes,
    ObjectMap,
    Rays,
    Surface,
    Trajectory,
    Truth,
)

OBJECTS, TRAJECTORY, RAYS, CONFIG = "objects.json", "trajectory.txt", "rays.parquet", "config.yaml"
PICTURE, RECORDING, SUMMARY = "map.png", "recording.rrd", "summary.json"
GROUNDTRUTH = "groundtruth"
TRUTH_OBJECTS, TRUTH_TRAJECTORY = "groundtruth_objects.json", "groundtruth_trajectory.txt"
DETECTIONS = "detections.jsonl"
SURFACE, SURFACE_BEFORE, CLOUD = "reconstruction.ply", "reconstruction_before.ply", "reconstruction_cloud.ply"
EVALUATION, REPORT = "evaluation.json", "report.html"
MOTIONS = "motions.parquet"
EXPORTS = ("objects.csv", "objects.geojson", "objects.ply", "graph.g2o", "map.mcap")
_FILES = FileSet(
    SUMMARY,
    (
        *(OBJECTS, TRAJECTORY, RAYS, CONFIG, TRUTH_OBJECTS, TRUTH_TRAJECTORY, DETECTIONS, PICTURE, RECORDING),
        *(SURFACE, SURFACE_BEFORE, CLOUD, MOTIONS, EVALUATION, REPORT, *EXPORTS),
    ),
    f"*.{DETECTIONS}",
)
"""Every file that belongs to a result, those of the commands that come after the run as well."""


@dataclass(frozen=True)
class RunResult:
    """What a run has to show.

    keyframes: before estimation. map_T_base: (K, 4, 4) after it (the keyframes' own in fixed mode). association: ray ->
    index into map.objects, -1 none. origins, directions: (R, 3) in map at the solved poses. residual: (R,) rad, the angle of
    the object off its ray, NaN without object. weight: (R,) robust weight in [0, 1]. summary: what summary.json gets.
    path: the full path that the log brought, at its own rate, before estimation; path_after: the same path after it.
    trace: the rounds of the estimation, and images: those of each camera, for the recording. surface: the room, where the
    log has depth images; surface_before: the same at the poses as the log brought them, where the settings ask for it.
    """

    map: ObjectMap
    keyframes: Keyframes
    map_T_base: Floats
    rays: Rays
    association: Association
    origins: Floats
    directions: Floats
    residual: Floats
    weight: Floats
    summary: dict[str, Any]
    settings: Settings
    cameras: tuple[Camera, ...]
    path: Trajectory
    path_after: Trajectory
    trace: tuple[Round, ...] = ()
    images: tuple[Images | None, ...] = ()
    surface: Surface | None = None
    surface_before: Surface | None = None


def prepare_output(out: Path) -> None:
    """Make the folder for a result and try it, before the long work.

    OutputError when no result could be written there, or only in the place of files that no run wrote: those of a log, a
    ground truth, or others that are called as ours are.
    """
    with disk_errors(out):
        if out.exists() and not out.is_dir():
            raise OutputError("the output is a file, not a folder", where=str(out), hint="name a folder with -o")
        _check_foreign(out)
        for name in _FILES.names(out):
            if (out / name).is_dir() and not (out / name).is_symlink():
                raise OutputError("a folder stands where a file of the result goes", where=str(out / name))
    try_folder(out, _FILES)


@contextmanager
def output_folder(out: Path) -> Iterator[None]:
    """The folder for a result, tried before the work that goes on inside; work that fails leaves no empty folder behind."""
    with no_empty_folders(out):
        prepare_output(out)
        yield


def write_result(
    result: RunResult, out: Path, truth: Truth | None = None, *, detected: tuple[CameraLog, ...] = ()
) -> tuple[str, ...]:
    """Write the whole result into the folder `out`, in place of an older one; other files there stay.

    Returns the names of the older one's files that went and have no successor, such as what was exported or reported of it.
    Killed at any moment, the folder holds no half file and no mix of two results, and a summary.json only with everything
    that belongs to it. OutputError when the disk refuses or another run writes there.

    truth is kept beside the result for `load_truth`, and drawn as it lies on the map. detected: cameras whose detections
    this run made; they are kept as detections.jsonl (of several cameras, with the camera's name), which a log can take over.
    """
    prepare_output(out)
    return replace_files(out, _FILES, _writers(result, truth, detected))


def clear_result(out: Path) -> tuple[str, ...]:
    """Take away what an earlier run wrote, but for its objects.json, in whose place a session writes; the names of it.

    What stayed would be taken for the session's own. Where there is a summary.json, it goes last: until then the folder is
    known as a result.
    """
    names = tuple(name for name in reversed(_FILES.names(out)) if name != OBJECTS and (out / name).is_file())
    with disk_errors(out):
        for name in names:
            (out / name).unlink(missing_ok=True)
    return names


def load_map(out: Path) -> ObjectMap:
    """The object map of the result in the folder `out`; OutputError says what is missing or malformed."""
    return read_objects(_existing(out, OBJECTS))


def load_trajectory(out: Path) -> Trajectory:
    """map_T_base of the result in the folder `out`; OutputError, with file and line, says what is missing or malformed."""
    file, ledger = _existing(out, TRAJECTORY), Ledger()
    try:
        trajectory = read_trajectory(file, ledger)
    except LogError as error:
        raise OutputError(error.message, where=error.where, hint=error.hint) from error
    if ledger.dropped:  # a log may be damaged, a result of our own may not
        raise OutputError(f"the trajectory is damaged: {ledger.lines()[0]}", where=str(file))
    return trajectory


def load_motions(out: Path) -> Motions | None:
    """The odometry between the poses of the result in the folder `out`, None where it had none; OutputError as above."""
    _existing(out, OBJECTS)
    file = out / MOTIONS
    return read_motions(file) if file.is_file() else None


def load_rays(out: Path) -> RaysTable:
    """The rays of the result in the folder `out`; OutputError where the file is missing, damaged, or of an older version."""
    return read_rays(out / RAYS)


def load_truth(path: Path) -> Truth | None:
    """The ground truth in `path`, None when a folder holds none; LogError when there is no such path, or it is malformed.

    path: an objects file, a folder named groundtruth, a log folder with one, or a result whose log brought a truth. The
    objects.json of a result folder is its estimate, never its truth: to compare two results, name that file itself.
    """
    if path.is_file():
        return Truth(read_truth_objects(path))
    if not path.is_dir():
        raise LogError("no such ground truth", where=str(path), hint="give --truth FILE")
    inner = path if path.resolve().name == GROUNDTRUTH else path / GROUNDTRUTH
    for objects, trajectory in (
        (path / TRUTH_OBJECTS, path / TRUTH_TRAJECTORY),
        (inner / OBJECTS, inner / TRAJECTORY),
    ):
        if objects.is_file() or trajectory.is_file():
            return Truth(
                read_truth_objects(objects) if objects.is_file() else (),
                read_trajectory(trajectory, Ledger()) if trajectory.is_file() else None,
            )
    return None


def hint_below(folder: Path) -> str | None:
    """Which folders in a folder are results, as a hint to name one of them; None where none is."""
    below = sorted(str(file.parent) for file in folder.glob(f"*/{SUMMARY}"))
    if not below:
        return None
    more = f" and {len(below) - 5} more" if len(below) > 5 else ""
    return f"its results lie in folders of their own: {', '.join(below[:5])}{more}"


def _existing(out: Path, name: str) -> Path:
    if not out.is_dir():
        raise OutputError("there is no such result folder", where=str(out))
    if not (out / name).is_file():
        hint = "was its run killed? run again" if has_staging(out) else hint_below(out)
        raise OutputError(f"no result here: {name} is missing", where=str(out), hint=hint)
    return out / name


def _writers(result: RunResult, truth: Truth | None, detected: tuple[CameraLog, ...]) -> dict[str, Callable[[Path], object]]:
    """What writes each file, by name."""
    stamps, first = np.unique(result.keyframes.stamps, return_index=True)
    path = Trajectory(stamps, result.map_T_base[first])
    writers: dict[str, Callable[[Path], object]] = {
        OBJECTS: lambda file: file.write_bytes(encode(dump_objects(result.map))),
        TRAJECTORY: lambda file: write_trajectory(path, file),
        RAYS: lambda file: file.write_bytes(dump_rays(result)),
        CONFIG: lambda file: file.write_bytes(encode(dump_settings(result.settings))),
        SUMMARY: lambda file: file.write_bytes(encode(dump_json(result.summary))),
    }
    motions = motions_of(result)
    if motions is not None:
        writers[MOTIONS] = lambda file: file.write_bytes(dump_motions(motions))
    if truth is not None and truth.objects:
        true = truth.objects
        writers[TRUTH_OBJECTS] = lambda file: file.write_bytes(encode(dump_truth_objects(true)))
    if truth is not None and truth.trajectory is not None:
        true_path = truth.trajectory
        writers[TRUTH_TRAJECTORY] = lambda file: write_trajectory(true_path, file)
    for camera_log in detected:
        if camera_log.detections is not None:
            name = DETECTIONS if len(detected) == 1 else f"{camera_log.camera.name}.{DETECTIONS}"
            writers[name] = partial(write_detections, camera_log.detections)
    if result.surface is not None:
        writers[SURFACE] = partial(write_mesh, result.surface)
        if result.settings.reconstruction.cloud:
            writers[CLOUD] = partial(write_cloud, result.surface)
    if result.surface_before is not None:
        writers[SURFACE_BEFORE] = partial(write_mesh, result.surface_before)
    drawn = lay_truth(result.map, truth) if truth is not None else None
    if result.settings.output.picture:
        from objslam.picture import draw_map

        writers[PICTURE] = lambda file: draw_map(result, file, drawn)
    if result.settings.output.recording:
        from objslam.viewer import write_recording

        writers[RECORDING] = lambda file: write_recording(result, file, drawn)
    return writers


def dump_json(data: Any) -> str:
    """Data as JSON text; arrays become lists, what is not finite null."""
    return json.dumps(_plain(data), indent=2, ensure_ascii=False, allow_nan=False) + "\n"


def _plain(data: Any) -> Any:
    if isinstance(data, np.ndarray | np.generic):
        data = data.tolist()
    if isinstance(data, dict):
        return {str(key): _plain(value) for key, value in data.items()}
    if isinstance(data, list | tuple):
        return [_plain(value) for value in data]
    if isinstance(data, float) and not math.isfinite(data):
        return None
    return data


def _check_foreign(out: Path) -> None:
    """OutputError where the folder holds files that a result would replace and that no run wrote."""
    if resembles_log(out):
        raise OutputError("this is a log, not a place for its result", where=str(out), hint="name another folder with -o")
    names = [name for name in _FILES.names(out) if (out / name).is_file()]
    if names and not is_cut_short(out, _FILES) and not _is_result(out, names):
        raise OutputError(
            f"in the way of a result, and not written by a run: {', '.join(names)}",
            where=str(out),
            hint="name another folder with -o, or move them",
        )


def _is_result(out: Path, names: list[str]) -> bool:
    """Whether our files in the folder, by name, are of a result, or of a live session that has not ended."""
    if out.resolve().name == GROUNDTRUTH:
        return False
    try:
        load_map(out)
        return names == [OBJECTS] or isinstance(json.loads((out / SUMMARY).read_bytes()), dict)
    except (OutputError, OSError, ValueError):
        return False
