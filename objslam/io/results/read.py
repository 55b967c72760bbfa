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
    """Read the object map of the result folder `out`. OutputError names what is missing or malformed."""
    return read_objects(_existing(out, files.OBJECTS))


def load_summary(out: Path) -> dict[str, Any]:
    """Read summary.json of the result folder `out`. OutputError if it is missing or not what a run writes."""
    return _load_json(_existing(out, files.SUMMARY), Summary)


def load_up(path: Path) -> Up:
    """Read which axis points up in the map of a result folder, or of the objects.json in it. It is z for a map without a
    summary."""
    out = path.parent if path.is_file() else path
    known = (out / files.SUMMARY).is_file() and (not path.is_file() or path.name == files.OBJECTS)
    up: Up = load_summary(out).get("up", "z") if known else "z"
    return up


def load_evaluation(out: Path) -> dict[str, Any] | None:
    """Read evaluation.json of the result folder `out`, None if there is none. OutputError if its content is invalid."""
    file = out / files.EVALUATION
    return _load_json(file, EvaluationFile) if file.is_file() else None


def load_doubts(out: Path) -> tuple[Doubt, ...] | None:
    """Read the doubts of the result folder `out`. None if it has no such file, as from an older
    version. OutputError if the file is invalid or there is no result."""
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
    """Read map_T_base at each keyframe of the result folder `out`. OutputError names a missing file or malformed line."""
    return _load_poses(_existing(out, files.TRAJECTORY))


def load_path(out: Path) -> Trajectory:
    """Read map_T_base at each pose of the recorded path. Raises the same errors as `load_trajectory`."""
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
    """Read the odometry between the poses of the result folder `out`. None if its run used none. OutputError if the file is
    invalid or there is no result."""
    _existing(out, files.OBJECTS)
    file = out / files.MOTIONS
    return read_motions(file) if file.is_file() else None


def load_rays(out: Path) -> RaysTable:
    """Read the rays of the result folder `out`. OutputError if the file is missing, damaged or of an older version."""
    return read_rays(_existing(out, files.RAYS))


def load_views(out: Path) -> Views | None:
    """Read the camera frames of the result folder `out`. None if it has none, as from an older version. OutputError if the
    file is damaged or there is no result."""
    _existing(out, files.OBJECTS)
    file = out / files.VIEWS
    return read_views(file) if file.is_file() else None


def load_truth(path: Path) -> Truth | None:
    """Read the ground truth at a path, or return None if a folder has no ground truth.

    Args:
        path: an objects file, a folder named groundtruth, a log folder with such a folder, or a result folder with the truth
            of its log. The objects.json of a result folder is not taken for the truth. To compare a result with another
            one, give the path of the other's objects.json itself.
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
    """Return whether the folder `out` is the map of a site, which has no path. OutputError as `load_summary`."""
    return (out / files.SUMMARY).is_file() and load_summary(out).get("map_frame") == files.SITE_FRAME


def refuse_site(out: Path, name: str) -> None:
    """Raise OutputError if the folder `out` is the map of a site, which never has the file `name` of a run."""
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
