"""Read RGB-D recordings of the TUM benchmark (Sturm et al., IROS 2012) with text files of detector boxes.

The numbered layout is the layout of the cube_slam sample. truth_cam_poses.txt has a pose for each image. The names of files
in boxes/, raw_imgs/ and depth_imgs/ begin with the number of the image, from 0. The stamped layout is the layout of the
benchmark. It has groundtruth.txt, rgb.txt, depth.txt, and box files whose names are stamps. The poses are camera poses, so
the base frame is the camera's frame.
"""

import lzma
import re
import tarfile
import zlib
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from objslam.core.camera import Camera
from objslam.core.coco import COCO_NAMES
from objslam.core.diagnostics import Ledger
from objslam.core.trajectory import Trajectory
from objslam.core.types import CameraLog, Detections, Images, Log
from objslam.errors import LogError
from objslam.frontend.box_depths import depths_at_boxes
from objslam.io.box_collector import BoxCollector
from objslam.io.camera_yaml import read_camera
from objslam.io.image_list import read_images
from objslam.io.safe_paths import Inside
from objslam.io.text import parse_numbers, read_bytes, reading, split_lines
from objslam.io.tum_trajectory import read_pose_table, read_trajectory, to_trajectory
from objslam.sources.log_folder import read_truth
from objslam.sources.tum_rgbd import TumOptions

_POSES, _BOXES, _IMAGES = "truth_cam_poses.txt", "boxes", ("raw_imgs", "depth_imgs")  # The names in the numbered layout.
_PATHS = ("groundtruth.txt", "groundtruth.txt.gz")  # The possible names of the file of poses in the stamped layout.
_LABEL = "object"  # The default label of boxes without a class.
_DEPTH_SCALE = 5000.0  # The depth scale of the benchmark's depth images, units per metre.
_FREIBURG3 = np.array([[535.4, 0.0, 320.1], [0.0, 539.2, 247.6], [0.0, 0.0, 1.0]])
"""The camera matrix of the camera freiburg3, px, from the benchmark."""
_STAMPED = re.compile(r"(\d+\.\d+)\.txt")  # The name of a box file, a stamp in s.
_ARCHIVES = ("*.tar", "*.tar.gz", "*.tgz", "*.tar.bz2", "*.tar.xz")  # The names of archives that may hold box files.
_MAX_SIZE = 1 << 20  # The largest box file in an archive, bytes. A usual file has a few hundred bytes.
_BAD_ARCHIVE = (tarfile.TarError, EOFError, zlib.error, lzma.LZMAError, OSError, ValueError)
"""The exceptions that reading a damaged archive raises."""


def is_numbered(path: Path) -> bool:
    """Return whether the folder has the files of the numbered layout."""
    return (path / _POSES).is_file() and (path / _BOXES).is_dir()


def is_stamped(path: Path) -> bool:
    """Return whether the folder has the files of the stamped layout."""
    return _stamped_path(path) is not None and ((path / "rgb.txt").is_file() or bool(_find_box_sets(path)))


def read_numbered(path: Path, ledger: Ledger, options: TumOptions = TumOptions()) -> Log:
    """Return the log of a folder in the numbered layout.

    A file whose name begins with the number n belongs to pose line n. Pose lines are counted from 0, and comments are not
    counted. Without camera.yaml, the calibration of freiburg3 is used. Files without a pose are dropped and counted, and so
    are further files with the same number. Raises LogError if the poses or the boxes are unusable.
    """
    with reading(path):
        table = read_pose_table(path / _POSES, ledger)
        stamp_of = dict(zip(table.rows.tolist(), table.values[:, 0].tolist(), strict=True))
        collector = BoxCollector()
        for number, file in _numbered(path / _BOXES, stamp_of, ledger).items():
            collector.add_frame(stamp_of[number], str(file))
            _add_boxes(read_bytes(file), str(file), options.label or _LABEL, collector, ledger)
        if not collector.stamps:
            raise LogError("no box file belongs to a pose", where=str(path / _BOXES), hint="number the files from 0")
        images = [_numbered_images(path / name, stamp_of, ledger) for name in _IMAGES]
        return _log(path, to_trajectory(table), collector.checked(ledger), images, options, ledger)


def read_stamped(path: Path, ledger: Ledger, options: TumOptions = TumOptions()) -> Log:
    """Return the log of a folder in the stamped layout. Boxes are optional if the folder has rgb.txt.

    The box files are in a folder or in a tar archive. The archive is not unpacked to disk. Box files are dropped and counted
    if they are not regular files, if their names are not stamps, or if they are too large (in an archive).
    Raises LogError if the poses or the boxes are unusable, or if the folder has several sets of boxes.
    """
    with reading(path):
        file = _stamped_path(path)
        if file is None:
            raise LogError(f"there is no {' or '.join(_PATHS)}", where=str(path))
        sets = _find_box_sets(path)
        if len(sets) > 1:
            names = ", ".join(source.name for source in sets)
            raise LogError(f"several sets of boxes: {names}", where=str(path), hint="keep one of them")
        detections = _read_box_set(sets[0], options.label or _LABEL, ledger) if sets else None
        lists = (path / "rgb.txt", path / "depth.txt")
        images = [read_images(listed, ledger) if listed.exists() else None for listed in lists]
        return _log(path, read_trajectory(file, ledger), detections, images, options, ledger)


def _log(
    path: Path,
    camera_path: Trajectory,
    detections: Detections | None,
    images: Sequence[Images | None],
    options: TumOptions,
    ledger: Ledger,
) -> Log:
    if (path / "camera.yaml").exists():
        camera = read_camera(path / "camera.yaml", ledger, place_needed=False, depth_scale=_DEPTH_SCALE)
        camera = replace(camera, base_T_camera=np.eye(4))
    else:
        ledger.warn(f"{path}: no camera.yaml, the calibration of TUM freiburg3 is used")
        camera = Camera("camera", 640, 480, _FREIBURG3.copy(), depth_scale=_DEPTH_SCALE)
    rgb, depth = images
    if detections and depth and options.with_range:
        detections = depths_at_boxes(detections, depth, camera, ledger)
    cameras = (CameraLog(camera, detections, rgb, depth),)
    return Log(path.resolve().name, cameras, localization=camera_path, truth=read_truth(path / "groundtruth", ledger))


def _stamped_path(path: Path) -> Path | None:
    return next((path / name for name in _PATHS if (path / name).is_file()), None)


def _numbered_images(folder: Path, stamp_of: dict[int, float], ledger: Ledger) -> Images | None:
    files = _numbered(folder, stamp_of, ledger) if folder.is_dir() else {}
    if not files:
        return None
    return Images(np.array([stamp_of[number] for number in files]), tuple(files.values()))


def _numbered(folder: Path, stamp_of: dict[int, float], ledger: Ledger) -> dict[int, Path]:
    """Return the files of a folder, in the order of the numbers at the start of their names. These numbers are the keys."""
    inside = Inside(folder)
    found: dict[int, Path] = {}
    for file in sorted(folder.iterdir()):
        match = re.match(r"\d+", file.name)
        number = int(match[0]) if match else -1
        reason = inside.reason_against(file)
        if reason is not None:
            ledger.drop(f"numbered file that {reason}", where=str(file))
        elif number not in stamp_of:
            ledger.drop("numbered file that no pose belongs to", where=str(file))
        elif number in found:
            ledger.drop("second file with the same number", where=str(file))
        else:
            found[number] = file
    return dict(sorted(found.items()))


def _find_box_sets(folder: Path) -> list[Path]:
    folders = [f for f in sorted(folder.iterdir()) if f.is_dir() and any(_STAMPED.fullmatch(i.name) for i in f.iterdir())]
    archives = sorted({file for pattern in _ARCHIVES for file in folder.glob(pattern) if file.is_file()})
    return folders + [archive for archive in archives if _holds_boxes(archive)]


def _read_box_set(source: Path, label: str, ledger: Ledger) -> Detections:
    """Return the detections of a set of box files, in the order of stamps. An archive is read up to its first damage."""
    files = _archive_files(source, ledger) if source.is_file() else _folder_files(source, ledger)
    collector = BoxCollector()
    for stamp, place, data in sorted(files, key=lambda file: file[0]):
        collector.add_frame(stamp, place)
        _add_boxes(data, place, label, collector, ledger)
    if not collector.stamps:
        raise LogError("none of the box files can be read", where=str(source))
    return collector.checked(ledger)


def _add_boxes(data: bytes, place: str, label: str, collector: BoxCollector, ledger: Ledger) -> None:
    """Add the boxes of a file to the collector's last frame. Each line is "[class] x y w h score", px, with the top left
    corner x, y."""
    for number, text in split_lines(data, place, ledger):
        where = f"{place}:{number}"
        values = parse_numbers(text.split())
        if values is None or len(values) not in (5, 6):
            ledger.drop('box line that is not "[class] x y w h score"', where=where)
            continue
        name = label
        if len(values) == 6:
            if values[0] not in range(len(COCO_NAMES)):
                ledger.drop("box line with a class number that is not in COCO", where=where)
                continue
            name = COCO_NAMES[int(values[0])]
        x, y, width, height, score = values[-5:]
        collector.add_box([x, y, x + width, y + height], name, score, where)


def _folder_files(folder: Path, ledger: Ledger) -> Iterator[tuple[float, str, bytes]]:
    for file in sorted(folder.iterdir()):
        match = _STAMPED.fullmatch(file.name)
        if match is None:
            ledger.drop("box file not named after a stamp", where=str(file))
        elif file.is_symlink() or not file.is_file():
            ledger.drop("box file that is not a regular file", where=str(file))
        else:
            yield float(match[1]), str(file), read_bytes(file)


def _archive_files(archive: Path, ledger: Ledger) -> Iterator[tuple[float, str, bytes]]:
    try:
        with tarfile.open(archive) as members:
            for member in members:
                name = member.name.rpartition("/")[2]
                place = f"{archive}:{name}"
                match = _STAMPED.fullmatch(name)
                if member.isdir():
                    continue
                if not member.isreg():
                    ledger.drop("box file that is not a regular file", where=place)
                elif match is None:
                    ledger.drop("box file not named after a stamp", where=place)
                elif member.size > _MAX_SIZE:
                    ledger.drop("box file that is too large", where=place)
                elif content := members.extractfile(member):
                    yield float(match[1]), place, content.read()
    except _BAD_ARCHIVE as error:
        ledger.warn(f"{archive}: damaged or cut off, the rest of the archive is left out ({error})")


def _holds_boxes(archive: Path) -> bool:
    try:
        with tarfile.open(archive) as members:
            return any(member.isreg() and _STAMPED.fullmatch(member.name.rpartition("/")[2]) for member in members)
    except _BAD_ARCHIVE:
        return False
