"""Read RGB-D recordings of the TUM benchmark (Sturm et al., IROS 2012) with text files of detector boxes.

The numbered layout is that of the cube_slam sample. truth_cam_poses.txt has a pose for each frame. The names of files in
boxes/, raw_imgs/ and depth_imgs/ begin with the frame's number, from 0. The stamped layout is that of the benchmark, with
groundtruth.txt, rgb.txt, depth.txt, and box files named after stamps. The poses are the camera's, so base is the camera.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from objslam.core.camera import Camera
from objslam.core.diagnostics import Ledger
from objslam.core.types import CameraLog, Detections, Images, Log, Trajectory
from objslam.errors import LogError
from objslam.frontend.box_depths import depths_at_boxes
from objslam.io.box_collector import BoxCollector
from objslam.io.camera_yaml import read_camera
from objslam.io.image_list import read_images
from objslam.io.safe_paths import Inside
from objslam.io.text import read_bytes, reading
from objslam.io.tum_trajectory import read_pose_table, read_trajectory, to_trajectory
from objslam.sources.log_folder import read_truth
from objslam.sources.tum_rgbd import TumOptions
from objslam.sources.tum_rgbd.box_files import add_boxes, find_box_sets, read_box_set

_POSES, _BOXES, _IMAGES = "truth_cam_poses.txt", "boxes", ("raw_imgs", "depth_imgs")  # The names in the numbered layout.
_PATHS = ("groundtruth.txt", "groundtruth.txt.gz")  # The names of the path in the stamped layout.
_LABEL = "object"  # The default label of boxes without a class.
_DEPTH_SCALE = 5000.0  # The units per metre of the benchmark's depth images.
_FREIBURG3 = np.array([[535.4, 0.0, 320.1], [0.0, 539.2, 247.6], [0.0, 0.0, 1.0]])
"""The camera matrix of freiburg3, px, from the benchmark."""


def is_numbered(path: Path) -> bool:
    """Return whether the folder has the numbered layout."""
    return (path / _POSES).is_file() and (path / _BOXES).is_dir()


def is_stamped(path: Path) -> bool:
    """Return whether the folder has the stamped layout."""
    return _stamped_path(path) is not None and ((path / "rgb.txt").is_file() or bool(find_box_sets(path)))


def read_numbered(path: Path, ledger: Ledger, options: TumOptions = TumOptions()) -> Log:
    """Read the numbered layout. Files whose names begin with n belong to pose line n, not counting comments.

    Without camera.yaml, the calibration is that of freiburg3. Files without a pose, and further files with the same number,
    are dropped and counted. Raises LogError if the poses or the boxes are unusable.
    """
    with reading(path):
        table = read_pose_table(path / _POSES, ledger)
        stamp_of = dict(zip(table.rows.tolist(), table.values[:, 0].tolist(), strict=True))
        collector = BoxCollector()
        for number, file in _numbered(path / _BOXES, stamp_of, ledger).items():
            collector.add_frame(stamp_of[number], str(file))
            add_boxes(read_bytes(file), str(file), options.label or _LABEL, collector, ledger)
        if not collector.stamps:
            raise LogError("no box file belongs to a pose", where=str(path / _BOXES), hint="number the files from 0")
        images = [_numbered_images(path / name, stamp_of, ledger) for name in _IMAGES]
        return _log(path, to_trajectory(table), collector.checked(ledger), images, options, ledger)


def read_stamped(path: Path, ledger: Ledger, options: TumOptions = TumOptions()) -> Log:
    """Read the stamped layout. Boxes are optional if the folder has rgb.txt. Raises the errors of `read_numbered`."""
    with reading(path):
        file = _stamped_path(path)
        if file is None:
            raise LogError(f"there is no {' or '.join(_PATHS)}", where=str(path))
        sets = find_box_sets(path)
        if len(sets) > 1:
            names = ", ".join(source.name for source in sets)
            raise LogError(f"several sets of boxes: {names}", where=str(path), hint="keep one of them")
        detections = read_box_set(sets[0], options.label or _LABEL, ledger) if sets else None
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
    """Map the number at the start of each file's name to the file, sorted by number."""
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
            ledger.drop("numbered file with the number of another file", where=str(file))
        else:
            found[number] = file
    return dict(sorted(found.items()))
