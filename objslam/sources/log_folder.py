"""Read and write log folders. This format on disk contains all data of a `Log`."""

import os
import shutil
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import TypeVar

from objslam.core.diagnostics import Ledger
from objslam.core.trajectory import Trajectory
from objslam.core.types import CameraLog, Images, Log, Truth
from objslam.errors import LogError, OutputError
from objslam.io.camera_yaml import read_camera, write_camera, write_mounts
from objslam.io.detections_jsonl import read_detections, write_detections
from objslam.io.folders import OLD, no_empty_folders, remove_leftovers, temporary_name
from objslam.io.image_list import read_images, write_images
from objslam.io.objects_json import dump_truth_objects, read_truth_objects
from objslam.io.text import misspelt, reading
from objslam.io.tum_trajectory import read_trajectory, write_trajectory
from objslam.sources.no_camera import NoCamera

CAMERA, CAMERAS, MOUNT = "camera.yaml", "cameras", "camera_poses.txt"
ODOMETRY, LOCALIZATION = "odometry.txt", "localization.txt"
MOUNTS = "mounts.yaml"  # The file of base_T_camera from tf, for a recording whose cameras have no calibration.
RGB, DEPTH, DETECTIONS = "rgb", "depth", "detections.jsonl"
_FILES = (CAMERA, MOUNT, ODOMETRY, LOCALIZATION, f"{RGB}.txt", f"{DEPTH}.txt", DETECTIONS)
_TEXT = (".txt", ".yaml", ".yml", ".json", ".jsonl", ".csv", ".gz")
"""The suffixes of the files in a folder whose names are checked for misspelt names of log files."""
TRUTH, TRUTH_OBJECTS, TRUTH_TRAJECTORY = "groundtruth", "objects.json", "trajectory.txt"

_T = TypeVar("_T")


def is_log_folder(path: Path) -> bool:
    """Return whether the folder contains a camera and a path of the robot (odometry or localisation)."""
    camera = (path / CAMERA).is_file() or (path / CAMERAS).is_dir()
    return camera and ((path / ODOMETRY).is_file() or (path / LOCALIZATION).is_file())


def resembles_log(path: Path) -> bool:
    """Return whether the folder contains a camera or a path of the robot (odometry or localisation)."""
    return any((path / name).exists() for name in (CAMERA, CAMERAS, ODOMETRY, LOCALIZATION))


def read_log_folder(path: Path, ledger: Ledger) -> Log:
    """Return the log in a log folder.

    Malformed lines are dropped, and counted with their file and line. Unusable lists of images and unusable ground truth are
    left out with a warning. If only one of odometry and localisation is usable, the other is left out with a warning. A file
    whose name is probably misspelt gives a warning. Images are not opened. Raises LogError if a camera, its detections or
    its mount is unusable, or if neither odometry nor localisation is usable.
    """
    with reading(path):
        if not path.is_dir():
            raise LogError("not a folder" if path.exists() else "no such folder", where=str(path))
        cameras, paths = _read_cameras(path, ledger), _read_paths(path, ledger)
        for folder in (path, *(path / CAMERAS / one.camera.name for one in cameras if (path / CAMERAS).is_dir())):
            _check_names(folder, ledger)
        return Log(path.resolve().name, cameras, *paths, read_truth(path / TRUTH, ledger))


def read_truth(folder: Path, ledger: Ledger) -> Truth | None:
    """Return the ground truth in a folder, or None if the folder has no usable ground truth.

    Unreadable files are left out with a warning.
    """
    objects = _optional(read_truth_objects, folder / TRUTH_OBJECTS, ledger)
    trajectory = _optional(lambda file: read_trajectory(file, ledger), folder / TRUTH_TRAJECTORY, ledger)
    return None if objects is None and trajectory is None else Truth(objects or (), trajectory)


def write_log_folder(log: Log, path: Path, *, overwrite: bool = False) -> None:
    """Write a log folder. Every number is read back as the same float. Rotations are written as unit quaternions.

    The content is written into a temporary folder that is renamed at the end. Images are linked or copied into rgb/ and
    depth/. If all images of a stream are already in the camera's folder, they keep their relative paths. Detections without
    frames are not written. Raises OutputError if the log has no cameras, or has neither odometry nor localisation. The error
    is also raised if the names of several cameras repeat or cannot be folder names, if a file cannot be written, or if
    `check_target` refuses the path.
    """
    path = Path(os.path.realpath(path))
    if not log.cameras or log.robot_path is None:
        missing = "odometry or localization" if log.cameras else "cameras"
        raise OutputError(f"cannot write a log without {missing}", where=log.name)
    names = [camera_log.camera.name for camera_log in log.cameras]
    files = all(name and not name.startswith(".") and "/" not in name and name.isprintable() for name in names)
    if len(set(names)) < len(names) or (len(names) > 1 and not files):
        raise OutputError(f"the cameras' names must differ and be usable as folder names, got {names}", where=log.name)
    _write_whole(path, overwrite, lambda fresh: _write_content(log, fresh, path))


def write_path(found: NoCamera, path: Path, *, overwrite: bool = False) -> tuple[str, ...]:
    """Write the robot's path and the cameras of a recording without images and boxes. Return the names of the files.

    With a detections.jsonl beside each camera.yaml, the folder is a log. If no camera is known, `MOUNTS` is written instead.
    Raises OutputError if a file cannot be written, or if `check_target` refuses the path.
    """
    paths = {ODOMETRY: found.odometry, LOCALIZATION: found.localization}
    known = {name: trajectory for name, trajectory in paths.items() if trajectory is not None}
    mounts = [MOUNTS] if found.mounts and not found.cameras else []

    def write(folder: Path) -> None:
        for name, trajectory in known.items():
            write_trajectory(trajectory, folder / name)
        _write_cameras(found.cameras, folder, path)
        if mounts:
            write_mounts(found.mounts, folder / MOUNTS)

    _write_whole(Path(os.path.realpath(path)), overwrite, write)
    places = (_place(camera_log, found.cameras) for camera_log in found.cameras)
    return (*known, *(str(place / CAMERA) for place in places), *mounts)


def _write_whole(path: Path, overwrite: bool, write: Callable[[Path], None]) -> None:
    """Make the folder `path` with the files that `write` writes. After an error, `path` is as it was before."""
    check_target(path, overwrite)
    with beside(path) as work, _writing(path):
        fresh = work / "new"
        fresh.mkdir()
        write(fresh)
        try:
            if path.exists():
                path.rename(work / OLD)
            fresh.rename(path)
        finally:
            if (work / OLD).exists() and not path.exists():
                (work / OLD).rename(path)


@contextmanager
def beside(path: Path) -> Iterator[Path]:
    """Yield an empty folder in the parent folder of `path`, on the same disk, and remove the empty folder at the end."""
    path = Path(os.path.realpath(path))
    with no_empty_folders(path.parent):
        with _writing(path):
            path.parent.mkdir(parents=True, exist_ok=True)
            work = Path(tempfile.mkdtemp(prefix=f"{temporary_name(path)}.", dir=path.parent))
        try:
            yield work
        finally:
            shutil.rmtree(work, ignore_errors=True)


def check_target(path: Path, overwrite: bool) -> None:
    """Raise OutputError if a log folder must not replace `path`. It may replace an empty folder, and with `overwrite` a log.

    The files that killed processes left beside `path` are removed first. A log that a killed process was replacing is put
    back.
    """
    with _writing(path):
        remove_leftovers(Path(os.path.realpath(path)))
        if path.exists() and not path.is_dir():
            raise OutputError("a file is in the way", where=str(path), hint="name another folder")
        if not path.exists() or not any(path.iterdir()):
            return
        # The conversion of a recording without a camera writes only its odometry and localisation.
        if not any((path / name).is_file() for name in (ODOMETRY, LOCALIZATION)):
            raise OutputError("the folder has files but is not a log", where=str(path), hint="name a new or empty folder")
        if not overwrite:
            hint = "name another folder, or replace all that is in it with --overwrite"
            raise OutputError("there is a log already", where=str(path), hint=hint)


@contextmanager
def _writing(path: Path) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        where = str(error.filename or path)
        raise OutputError(f"cannot be written: {error.strerror or error}", where=where) from error


def _read_cameras(path: Path, ledger: Ledger) -> tuple[CameraLog, ...]:
    single, several = path / CAMERA, path / CAMERAS
    if single.exists() and several.exists():
        raise LogError(f"the folder has both {CAMERA} and {CAMERAS}/", where=str(path), hint="keep one of the two")
    if not several.exists():
        return (_read_camera_log(path, None, ledger),)
    folders = sorted(f for f in several.iterdir() if f.is_dir() and not f.name.startswith("."))
    if not folders:
        raise LogError("no camera in it", where=str(several), hint=f"put each camera into a folder with a {CAMERA}")
    return tuple(_read_camera_log(folder, folder.name, ledger) for folder in folders)


def _read_camera_log(folder: Path, name: str | None, ledger: Ledger) -> CameraLog:
    if not (folder / CAMERA).exists():
        hint = "write one with the image's size, camera_matrix, the distortion and base_T_camera, as README.md shows"
        raise LogError(f"there is no {CAMERA}", where=str(folder), hint=hint)
    mount = read_trajectory(folder / MOUNT, ledger) if (folder / MOUNT).exists() else None
    detections = folder / DETECTIONS
    return CameraLog(
        camera=read_camera(folder / CAMERA, ledger, name=name, place_needed=mount is None),
        detections=read_detections(detections, ledger) if detections.exists() else None,
        rgb=_optional(lambda file: read_images(file, ledger), folder / f"{RGB}.txt", ledger),
        depth=_optional(lambda file: read_images(file, ledger), folder / f"{DEPTH}.txt", ledger),
        mount=mount,
    )


def _check_names(folder: Path, ledger: Ledger) -> None:
    """Warn of files whose names are probably misspelt. Images are left out, because a folder may contain 100,000 images."""
    files = [file for file in folder.iterdir() if file.suffix.lower() in _TEXT and file.is_file()]
    for name, meant in misspelt(sorted(file.name for file in files), _FILES).items():
        ledger.warn(f"{folder / name}: no file of a log has this name, so it is not read (did you mean {meant}?)")


def _read_paths(path: Path, ledger: Ledger) -> tuple[Trajectory | None, Trajectory | None]:
    paths: dict[str, Trajectory] = {}
    refused: dict[str, LogError] = {}
    for name in (ODOMETRY, LOCALIZATION):
        try:
            if (path / name).exists():
                paths[name] = read_trajectory(path / name, ledger)
        except LogError as error:
            refused[name] = error
    if not paths and not refused:
        other = [
            (file.name, name) for name in (ODOMETRY, LOCALIZATION) for file in sorted(path.glob(f"{Path(name).stem}.*"))
        ]
        hint = "; ".join(f"found {found}: rename it to {name}" for found, name in other) or "add one of the two"
        raise LogError(f"the log has neither {ODOMETRY} nor {LOCALIZATION}", where=str(path), hint=hint)
    if not paths:
        raise next(iter(refused.values()))
    for name, reason in refused.items():
        ledger.do_without(name, reason)
    return paths.get(ODOMETRY), paths.get(LOCALIZATION)


def _optional(read: Callable[[Path], _T], file: Path, ledger: Ledger) -> _T | None:
    try:
        return read(file) if file.exists() else None
    except LogError as error:
        ledger.warn(f"{error}: left out")
        return None


def _place(camera_log: CameraLog, cameras: tuple[CameraLog, ...]) -> Path:
    """Return the folder of a camera, relative to the folder of the log."""
    return Path() if len(cameras) == 1 else Path(CAMERAS, camera_log.camera.name)


def _write_cameras(cameras: tuple[CameraLog, ...], folder: Path, final: Path) -> None:
    for camera_log in cameras:
        place = _place(camera_log, cameras)
        own = folder / place
        own.mkdir(parents=True, exist_ok=True)
        write_camera(camera_log.camera, own / CAMERA)
        if camera_log.mount is not None:
            write_trajectory(camera_log.mount, own / MOUNT)
        if camera_log.detections is not None and len(camera_log.detections.frame_stamps):
            write_detections(camera_log.detections, own / DETECTIONS)
        for images, kind in ((camera_log.rgb, RGB), (camera_log.depth, DEPTH)):
            if images is not None and images.paths:
                write_images(_link_images(images, kind, own, final / place), own / f"{kind}.txt")


def _write_content(log: Log, folder: Path, final: Path) -> None:
    _write_cameras(log.cameras, folder, final)
    truth = log.truth or Truth()
    paths = {ODOMETRY: log.odometry, LOCALIZATION: log.localization, f"{TRUTH}/{TRUTH_TRAJECTORY}": truth.trajectory}
    for name, trajectory in paths.items():
        if trajectory is not None:
            (folder / name).parent.mkdir(exist_ok=True)
            write_trajectory(trajectory, folder / name)
    if truth.objects:
        (folder / TRUTH).mkdir(exist_ok=True)
        (folder / TRUTH / TRUTH_OBJECTS).write_text(dump_truth_objects(truth.objects), encoding="utf-8")


def _link_images(images: Images, kind: str, folder: Path, final: Path) -> Images:
    """Link or copy images into `folder`, and return them with their new paths. `folder` is later renamed to `final`."""
    sources = [path.resolve() for path in images.paths]
    distinct = list(dict.fromkeys(sources))
    names = [source.name for source in distinct]
    if all(source.is_relative_to(final) for source in distinct):
        places = [source.relative_to(final) for source in distinct]
    elif len(set(names)) == len(names) and all(name == name.strip() and name.isprintable() for name in names):
        places = [Path(kind, name) for name in names]
    else:
        places = [Path(kind, f"{index:06d}{source.suffix}") for index, source in enumerate(distinct)]
    targets = {source: folder / place for source, place in zip(distinct, places, strict=True)}
    for source, target in targets.items():
        target.parent.mkdir(parents=True, exist_ok=True)
        if target.exists():  # Two streams may list the same file.
            continue
        try:
            os.link(source, target)
        except OSError:  # The source is on another disk or has another owner.
            shutil.copyfile(source, target)
    return replace(images, paths=tuple(targets[source] for source in sources))
