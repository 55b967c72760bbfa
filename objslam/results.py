"""The result of a run on disk: a folder that is either whole or does not claim to be."""

from __future__ import annotations

import errno
import fcntl
import io
import json
import math
import os
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from objslam.config import Settings, dump_settings
from objslam.errors import LogError, OutputError
from objslam.folders import no_empty_folders
from objslam.ledger import Ledger
from objslam.matching import lay_truth
from objslam.motions_file import Motions, dump_motions, motions_of, read_motions
from objslam.objects_file import dump_objects, dump_truth_objects, read_objects, read_truth_objects
from objslam.ply_file import write_cloud, write_mesh
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
_OWN = (
    *(SUMMARY, OBJECTS, TRAJECTORY, RAYS, CONFIG, TRUTH_OBJECTS, TRUTH_TRAJECTORY, DETECTIONS, PICTURE, RECORDING),
    *(SURFACE, SURFACE_BEFORE, CLOUD, MOTIONS, EVALUATION, REPORT, *EXPORTS),
)
"""Every file that belongs to a result, the summary first: it goes first and comes last, so that it stands for the whole."""
_STAGING = ".objslam-staging"
_SWAPPING = "swapping"
"""In the staging folder from before the first old file goes: what a killed swap left beside it is no one's but ours."""
_UNSUPPORTED = (errno.EINVAL, errno.ENOTSUP, errno.ENOLCK, errno.ENOSYS)
"""What network file systems answer that can neither lock nor sync a folder: there we go on without."""


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
    with _disk(out):
        if out.exists() and not out.is_dir():
            raise OutputError("the output is a file, not a folder", where=str(out), hint="name a folder with -o")
        _check_foreign(out)
        out.mkdir(parents=True, exist_ok=True)
        for name in _OWN:
            if (out / name).is_dir() and not (out / name).is_symlink():
                raise OutputError("a folder stands where a file of the result goes", where=str(out / name))
        with _staged(out) as staging:
            _write(staging / "probe", b"objslam")


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

    Everything is written beside the result first. Only then the old files go, all of them, and the new ones come by rename,
    summary.json last. Killed at any moment, the folder holds no half file and no mix of two results, and a summary.json
    only with everything that belongs to it. OutputError when the disk refuses or another run writes there. truth is kept
    beside the result for `load_truth`, and drawn as it lies on the map. detected: cameras whose detections this run made;
    they are kept as detections.jsonl (of several cameras, with the camera's name), which a log can take over.
    """
    prepare_output(out)
    with _disk(out), _staged(out) as staging:
        for name, write in _writers(result, truth, detected).items():
            write(staging / name)
            _sync(staging / name)
        _sync(staging)
        return _swap(staging, out)


def write_file(file: Path, data: bytes) -> None:
    """Write one file under a temporary name and rename it; OutputError, with the file's own name, when the disk refuses."""
    temporary = file.with_name(f".{file.name}.{os.getpid()}")
    with _disk(file, only=True):
        try:
            _write(temporary, data)
            temporary.replace(file)
            _sync(file.parent)
        finally:
            temporary.unlink(missing_ok=True)


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
        hint = "was its run killed? run again" if (out / _STAGING).exists() else hint_below(out)
        raise OutputError(f"no result here: {name} is missing", where=str(out), hint=hint)
    return out / name


def _writers(result: RunResult, truth: Truth | None, detected: tuple[CameraLog, ...]) -> dict[str, Callable[[Path], None]]:
    """What writes each file, by name."""
    stamps, first = np.unique(result.keyframes.stamps, return_index=True)
    path = Trajectory(stamps, result.map_T_base[first])
    writers: dict[str, Callable[[Path], None]] = {
        OBJECTS: lambda file: _write(file, _encode(dump_objects(result.map))),
        TRAJECTORY: lambda file: write_trajectory(path, file),
        RAYS: lambda file: _write(file, _rays_parquet(result)),
        CONFIG: lambda file: _write(file, _encode(dump_settings(result.settings))),
        SUMMARY: lambda file: _write(file, _encode(dump_json(result.summary))),
    }
    motions = motions_of(result)
    if motions is not None:
        writers[MOTIONS] = lambda file: _write(file, dump_motions(motions))
    if truth is not None and truth.objects:
        true = truth.objects
        writers[TRUTH_OBJECTS] = lambda file: _write(file, _encode(dump_truth_objects(true)))
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


def _rays_parquet(result: RunResult) -> bytes:
    """rays.parquet: one row a ray; object is the id in objects.json, null where none."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    ids = np.array([o.id for o in result.map.objects] or [0], dtype=np.int64)
    index = result.association.object
    names = np.array([_encode(name).decode() for name in result.rays.label_names], dtype=object)
    cameras = np.array([_encode(camera.name).decode() for camera in result.cameras], dtype=object)
    table = pa.table(
        {
            "stamp": pa.array(result.keyframes.stamps[result.rays.keyframe]),
            "object": pa.array(ids[index], mask=index < 0),
            "origin": pa.FixedSizeListArray.from_arrays(pa.array(result.origins.ravel()), 3),
            "direction": pa.FixedSizeListArray.from_arrays(pa.array(result.directions.ravel()), 3),
            "residual": pa.array(result.residual, mask=np.isnan(result.residual)),
            "weight": pa.array(result.weight),
            "label": pa.array(names[result.rays.label], type=pa.string()),
            "score": pa.array(result.rays.score),
            "camera": pa.array(cameras[result.keyframes.camera[result.rays.keyframe]], type=pa.string()),
            "box": pa.FixedSizeListArray.from_arrays(pa.array(result.rays.box.ravel()), 4),
        }
    )
    buffer = io.BytesIO()
    pq.write_table(table, buffer)
    return buffer.getvalue()


def _own(folder: Path) -> tuple[str, ...]:
    return _OWN + tuple(sorted(file.name for file in folder.glob(f"*.{DETECTIONS}")))


def _check_foreign(out: Path) -> None:
    """OutputError where the folder holds files that a result would replace and that no run wrote."""
    if resembles_log(out):
        raise OutputError("this is a log, not a place for its result", where=str(out), hint="name another folder with -o")
    names = [name for name in _own(out) if (out / name).is_file()]
    if names and not _is_cut_short(out) and not _is_result(out, names):
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


def _swap(staging: Path, out: Path) -> tuple[str, ...]:
    """Put the staged files in the place of the old ones; the order is what keeps a killed run from a mix."""
    removed = tuple(name for name in _own(out) if (out / name).exists() and not (staging / name).exists())
    _write(staging / _SWAPPING, b"")
    _sync(staging)
    for name in _own(out):
        (out / name).unlink(missing_ok=True)
        if name == SUMMARY:
            _sync(out)
    _sync(out)
    for name in reversed(_own(staging)):
        if (staging / name).exists():
            if name == SUMMARY:
                _sync(out)
            (staging / name).replace(out / name)
    _sync(out)
    return removed


def _write(file: Path, data: bytes) -> None:
    with file.open("wb") as stream:
        stream.write(data)
        stream.flush()
        os.fsync(stream.fileno())


def _encode(text: str) -> bytes:
    try:
        return text.encode()
    except UnicodeEncodeError as error:
        bad = error.object[max(error.start - 20, 0) : error.end]
        raise OutputError(f"text that cannot be written (half of a surrogate pair) near {bad!r}") from error


def _sync(path: Path) -> None:
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    except OSError as error:
        if error.errno not in _UNSUPPORTED:
            raise
    finally:
        os.close(handle)


def _is_cut_short(out: Path) -> bool:
    """Whether a swap began in the folder and did not end: then it holds parts of a result."""
    return (out / _STAGING / _SWAPPING).exists() and not (out / SUMMARY).exists()


@contextmanager
def _staged(out: Path) -> Iterator[Path]:
    """An empty staging folder in `out`, and `out` to ourselves as long as the process lives; gone afterwards.

    A swap that was cut short leaves it, as the sign of whose the rest is; here that rest goes too. OutputError when another
    run has it.
    """
    staging = out / _STAGING
    handle = os.open(out, os.O_RDONLY)
    try:
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            raise OutputError("another run is writing here", where=str(out), hint="name another folder with -o") from error
        except OSError as error:
            if error.errno not in _UNSUPPORTED:
                raise
        if staging.exists():  # a killed run left it: the lock says that nobody is at it
            if _is_cut_short(out):
                for name in _own(out):
                    (out / name).unlink(missing_ok=True)
            shutil.rmtree(staging)
        staging.mkdir()
        try:
            yield staging
        finally:
            if not _is_cut_short(out):
                shutil.rmtree(staging, ignore_errors=True)
    finally:
        os.close(handle)


@contextmanager
def _disk(path: Path, *, only: bool = False) -> Iterator[None]:
    """What the disk refuses, as an OutputError of one line; it names the file in question, or (only) always the path."""
    try:
        yield
    except OSError as error:
        where = str(path if only or error.filename is None else error.filename)
        raise OutputError(f"cannot write or read: {error.strerror or error}", where=where) from error
