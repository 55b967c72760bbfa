"""Readers of a result folder: its map, summary, path, rays, odometry and ground truth."""

import json
from pathlib import Path
from typing import Any

from pydantic import BaseModel

from objslam.core.diagnostics import Ledger
from objslam.core.object_map import ObjectMap
from objslam.core.result import Doubt
from objslam.core.trajectory import Trajectory
from objslam.core.types import Truth, Up
from objslam.errors import LogError, OutputError
from objslam.io.atomic_files import has_staging
from objslam.io.objects_json import read_objects, read_truth_objects
from objslam.io.odometry_parquet import Motions, read_motions
from objslam.io.rays_parquet import RaysTable, read_rays
from objslam.io.results import files
from objslam.io.results.shapes import DoubtsFile, EvaluationFile, Summary, fault_of
from objslam.io.tum_trajectory import read_trajectory
from objslam.io.views_parquet import Views, read_views


def load_map(out: Path) -> ObjectMap:
    """Return the object map of the result folder `out`. Raises OutputError, which names the missing or malformed part."""
    return read_objects(_existing(out, files.OBJECTS))


def load_summary(out: Path) -> dict[str, Any]:
    """Return the content of summary.json in the result folder `out`. Raises OutputError if it is missing or invalid."""
    return _load_json(_existing(out, files.SUMMARY), Summary)


def load_up(path: Path) -> Up:
    """Return the axis that points up in a map. It is "z" for a map without a summary.

    path: a result folder or a file of objects. Only a file named objects.json takes the axis from the summary beside it.
    """
    out = path.parent if path.is_file() else path
    known = (out / files.SUMMARY).is_file() and (not path.is_file() or path.name == files.OBJECTS)
    up: Up = load_summary(out).get("up", "z") if known else "z"
    return up


def load_evaluation(out: Path) -> dict[str, Any] | None:
    """Return the content of evaluation.json in the result folder `out`, or None if this file is missing.

    Raises OutputError if the content is invalid.
    """
    file = out / files.EVALUATION
    return _load_json(file, EvaluationFile) if file.is_file() else None


def load_doubts(out: Path) -> tuple[Doubt, ...] | None:
    """Return the doubts of the result folder `out`, or None if doubts.json is missing, as in results of older versions.

    Raises OutputError if doubts.json is invalid or the folder has no result.
    """
    _existing(out, files.OBJECTS)
    file = out / files.DOUBTS
    return tuple(Doubt.from_dict(entry) for entry in _load_json(file, DoubtsFile)["doubts"]) if file.is_file() else None


def _load_json(file: Path, shape: type[BaseModel]) -> dict[str, Any]:
    try:
        data = json.loads(file.read_text(encoding="utf-8"), parse_constant=_refuse_constant)
    except OSError as error:
        raise OutputError(f"cannot be read: {error.strerror or error}", where=str(file)) from error
    except (ValueError, RecursionError) as error:
        raise OutputError(f"is not JSON: {error}", where=str(file)) from error
    if not isinstance(data, dict):
        raise OutputError("is not a JSON object", where=str(file))
    if (fault := fault_of(data, shape)) is not None:
        raise OutputError(f"not what objslam writes: {fault}", where=str(file))
    return data


def _refuse_constant(name: str) -> None:
    raise ValueError(f"{name} is not a JSON number")


def load_trajectory(out: Path) -> Trajectory:
    """Return map_T_base at each keyframe of the result folder `out`.

    Raises OutputError, which names the missing file or the malformed line.
    """
    return _load_poses(_existing(out, files.TRAJECTORY))


def load_path(out: Path) -> Trajectory:
    """Return map_T_base at each pose of the recorded path. Raises the same errors as `load_trajectory`."""
    return _load_poses(_existing(out, files.PATH))


def _load_poses(file: Path) -> Trajectory:
    ledger = Ledger()
    try:
        trajectory = read_trajectory(file, ledger)
    except LogError as error:
        raise OutputError(error.message, where=error.where, hint=error.hint) from error
    if ledger.dropped:  # a log may have damaged lines, but a result must not
        raise OutputError(f"the trajectory is damaged: {ledger.lines()[0]}", where=str(file))
    return trajectory


def load_motions(out: Path) -> Motions | None:
    """Return the odometry between the poses of the result folder `out`, or None if its run used no odometry.

    Raises OutputError if motions.parquet is invalid or the folder has no result.
    """
    _existing(out, files.OBJECTS)
    file = out / files.MOTIONS
    return read_motions(file) if file.is_file() else None


def load_rays(out: Path) -> RaysTable:
    """Return the rays of the result folder `out`. Raises OutputError if rays.parquet is missing or invalid."""
    return read_rays(_existing(out, files.RAYS))


def load_views(out: Path) -> Views | None:
    """Return the camera frames of the result folder `out`, or None if views.parquet is missing, as from older versions.

    Raises OutputError if views.parquet is damaged or the folder has no result.
    """
    _existing(out, files.OBJECTS)
    file = out / files.VIEWS
    return read_views(file) if file.is_file() else None


def load_truth(path: Path) -> Truth | None:
    """Return the ground truth at a path, or None if a folder has no ground truth.

    Args:
        path: an objects file, a folder named groundtruth, a log folder with such a folder, or a result folder with the truth
            of its log. The objects.json in a result folder is not read as the truth. To compare two results, give the path
            of the objects.json of one result as the truth.
    Raises:
        LogError: the path does not exist, or the truth is malformed.
    """
    if path.is_file():
        return Truth(read_truth_objects(path))
    if not path.is_dir():
        raise LogError("no such ground truth", where=str(path), hint="give --truth FILE")
    inner = path if path.resolve().name == files.GROUNDTRUTH else path / files.GROUNDTRUTH
    for objects, trajectory in (
        (path / files.TRUTH_OBJECTS, path / files.TRUTH_TRAJECTORY),
        (inner / files.OBJECTS, inner / files.TRAJECTORY),
    ):
        if objects.is_file() or trajectory.is_file():
            return Truth(
                read_truth_objects(objects) if objects.is_file() else (),
                read_trajectory(trajectory, Ledger()) if trajectory.is_file() else None,
            )
    return None


def is_site(out: Path) -> bool:
    """Return whether the folder `out` is the map of a site, which has no path. Raises the same errors as `load_summary`."""
    return (out / files.SUMMARY).is_file() and load_summary(out).get("map_frame") == files.SITE_FRAME


def refuse_site(out: Path, name: str) -> None:
    """Raise OutputError if the folder `out` is the map of a site. name: the file of a run that a site does not have."""
    if is_site(out):
        hint = f"look at {files.PICTURE}, or give the result of one of its sessions"
        raise OutputError(f"this is the map of a site, which has no {name}", where=str(out), hint=hint)


def _existing(out: Path, name: str) -> Path:
    if not out.is_dir():
        raise OutputError("there is no such result folder", where=str(out))
    if not (out / name).is_file():
        if name != files.SUMMARY:
            refuse_site(out, name)
        hint = "its run did not finish: run it again" if has_staging(out) else files.hint_below(out)
        raise OutputError(f"no result here: {name} is missing", where=str(out), hint=hint)
    return out / name
