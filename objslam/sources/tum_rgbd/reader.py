"""RGB-D recordings in the style of the TUM benchmark (Sturm et al., IROS 2012) with the text files of a detector.

Two layouts. Numbered (as cube_slam ships its sample): truth_cam_poses.txt with one pose a frame, and boxes/, raw_imgs/,
depth_imgs/ whose files begin with the frame's number, from 0. Stamped (the benchmark's own): groundtruth.txt, rgb.txt,
depth.txt, and box files named after the stamp in a folder or a tar archive. The path is the camera's, so base is the camera.
"""

from __future__ import annotations

import re
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
from objslam.sources.tum_rgbd.box_files import find_box_sets, read_box_set
from objslam.sources.tum_rgbd.box_text import add_boxes

_POSES, _BOXES, _RGB, _DEPTH = "truth_cam_poses.txt", "boxes", "raw_imgs", "depth_imgs"  # the names in the numbered layout
_PATHS = ("groundtruth.txt", "groundtruth.txt.gz")  # the names of the path in the stamped layout
_LABEL = "object"  # the label of boxes without a class, where the options give none
_DEPTH_SCALE = 5000.0  # units per metre, in all depth images of the benchmark
_FREIBURG3 = np.array([[535.4, 0.0, 320.1], [0.0, 539.2, 247.6], [0.0, 0.0, 1.0]])  # px, as the benchmark gives it


def is_numbered(path: Path) -> bool:
    """Whether the folder has the numbered layout."""
    return (path / _POSES).is_file() and (path / _BOXES).is_dir()


def is_stamped(path: Path) -> bool:
    """Whether the folder has the stamped layout."""
    return _stamped_path(path) is not None and ((path / "rgb.txt").is_file() or bool(find_box_sets(path)))


def read_numbered(path: Path, ledger: Ledger, options: TumOptions = TumOptions()) -> Log:
    """Read the numbered layout: line n of the poses (comments not counted) belongs to the files whose name begins with n.

    The camera is that of freiburg3 unless there is a camera.yaml. Files without a pose and second files of one number are
    dropped and counted. LogError where poses or boxes cannot be used.
    """
    with reading(path):
        table = read_pose_table(path / _POSES, ledger)
        stamp_of = dict(zip(table.rows.tolist(), table.values[:, 0].tolist(), strict=True))
        collector = BoxCollector()
        for number, file in _numbered(path / _BOXES, stamp_of, ledger).items():
            collector.add_frame(stamp_of[number], str(file))
            add_boxes(read_bytes(file), str(file), options.label or _LABEL, collector, ledger)
        if not collector.stamps:
            raise LogError("no box file that a pose belongs to", where=str(path / _BOXES))
        rgb, depth = (_numbered_images(path / name, stamp_of, ledger) for name in (_RGB, _DEPTH))
        return _log(path, to_trajectory(table), collector.checked(ledger), rgb, depth, options.with_range, ledger)


def read_stamped(path: Path, ledger: Ledger, options: TumOptions = TumOptions()) -> Log:
    """Read the stamped layout; boxes may be missing where there is rgb.txt. Errors as in `read_numbered`."""
    with reading(path):
        file = _stamped_path(path)
        if file is None:
            raise LogError(f"there is no {' or '.join(_PATHS)}", where=str(path))
        sets = find_box_sets(path)
        if len(sets) > 1:
            names = ", ".join(source.name for source in sets)
            raise LogError(f"several sets of boxes: {names}", where=str(path), hint="keep one of them")
        detections = read_box_set(sets[0], options.label or _LABEL, ledger) if sets else None
        rgb, depth = (
            read_images(path / name, ledger) if (path / name).exists() else None for name in ("rgb.txt", "depth.txt")
        )
        return _log(path, read_trajectory(file, ledger), detections, rgb, depth, options.with_range, ledger)


def _log(
    path: Path,
    camera_path: Trajectory,
    detections: Detections | None,
    rgb: Images | None,
    depth: Images | None,
    with_range: bool,
    ledger: Ledger,
) -> Log:
    camera = _camera(path, ledger)
    if detections and depth and with_range:
        detections = depths_at_boxes(detections, depth, camera, ledger)
    camera_log = CameraLog(camera, detections, rgb, depth)
    name = path.resolve().name
    return Log(name, (camera_log,), localization=camera_path, truth=read_truth(path / "groundtruth", ledger))


def _camera(path: Path, ledger: Ledger) -> Camera:
    file = path / "camera.yaml"
    if file.exists():
        camera = read_camera(file, ledger, place_needed=False, depth_scale=_DEPTH_SCALE)
        return replace(camera, base_T_camera=np.eye(4))
    ledger.warn(f"{path}: no camera.yaml, the camera is taken as that of TUM freiburg3")
    return Camera("camera", 640, 480, _FREIBURG3.copy(), depth_scale=_DEPTH_SCALE)


def _stamped_path(path: Path) -> Path | None:
    return next((path / name for name in _PATHS if (path / name).is_file()), None)


def _numbered_images(folder: Path, stamp_of: dict[int, float], ledger: Ledger) -> Images | None:
    files = _numbered(folder, stamp_of, ledger) if folder.is_dir() else {}
    if not files:
        return None
    return Images(np.array([stamp_of[number] for number in files]), tuple(files.values()))


def _numbered(folder: Path, stamp_of: dict[int, float], ledger: Ledger) -> dict[int, Path]:
    """The files of a folder by the number that their name begins with, in its order."""
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
            ledger.drop("numbered file whose number another has", where=str(file))
        else:
            found[number] = file
    return dict(sorted(found.items()))
