"""How good a map is, and a path: compared with the ground truth."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from objslam.core.arrays import Floats
from objslam.core.geometry import align as align_points
from objslam.core.geometry import interpolate
from objslam.core.object_map import MapObject, ObjectMap
from objslam.core.types import Trajectory, Truth, TruthObject
from objslam.errors import ConfigError, LogError
from objslam.evaluation.alignment import IDENTITY, Alignment, Transform, align_objects, correspondences, match_points
from objslam.io.atomic_files import write_file
from objslam.results.files import EVALUATION, GROUNDTRUTH, OBJECTS, TRAJECTORY, dump_json
from objslam.results.read import load_map, load_trajectory, load_truth

MAX_TRUTH_GAP = 1.0
"""The longest gap between two true poses, s, that is interpolated; a pose in a longer one has no truth."""


@dataclass(frozen=True)
class Match:
    """A map object and the true object that it is; error (m) after the alignment, offset (3,) is map minus truth."""

    object: MapObject
    truth: TruthObject
    offset: Floats

    @property
    def error(self) -> float:
        """Distance between the two, m."""
        return float(np.linalg.norm(self.offset))


@dataclass(frozen=True)
class ObjectScores:
    """The map against the true objects: what was matched (one-to-one, same label, within the radius), missed and false.

    An unresolved object claims no position. It is neither matched nor false, only counted.
    """

    matches: tuple[Match, ...]
    missed: tuple[TruthObject, ...]
    false: tuple[MapObject, ...]
    unresolved: int
    transform: Transform

    @property
    def errors(self) -> Floats:
        """Position errors (matched,), m."""
        return np.array([m.error for m in self.matches])

    @property
    def precision(self) -> float | None:
        """Share of the mapped objects that are matched; None when none is mapped."""
        return _share(len(self.matches), len(self.false))

    @property
    def recall(self) -> float | None:
        """Share of the true objects that are matched."""
        return _share(len(self.matches), len(self.missed))


@dataclass(frozen=True)
class PathScores:
    """The path against the true one, at the stamps of the path that the truth covers.

    The errors are those of the translation (absolute trajectory error; Sturm et al., IROS 2012).
    """

    errors: Floats  # (N,) m, after aligning the path by itself.
    errors_with_map: Floats | None  # (N,) m, after the alignment of the objects; None without objects.
    outside: int  # The number of stamps without truth.
    transform: Transform  # The alignment of the path by itself.


@dataclass(frozen=True)
class Evaluation:
    """The comparison of a result with the ground truth; each part is None where there was nothing to compare."""

    objects: ObjectScores | None
    path: PathScores | None
    align: Alignment
    radius: float
    warnings: tuple[str, ...] = ()
    truth: str | None = None
    """What it was compared with, where that is not the truth that the log brought: a path."""

    def to_dict(self) -> dict[str, Any]:
        """What evaluation.json holds: counts, m and s; null where there is no value."""
        return {
            "truth": self.truth,
            "align": self.align,
            "radius": self.radius,
            **_object_dict(self.objects),
            **_path_dict(self.path),
            "warnings": list(self.warnings),
            **_listing(self.objects),
        }


def evaluate(
    map: ObjectMap,
    truth: Truth | None,
    trajectory: Trajectory | None = None,
    *,
    align: Alignment = "none",
    radius: float = 0.5,
) -> Evaluation:
    """Compare a map, and the path where both are there, with the ground truth.

    Args:
        trajectory: map_T_base.
        align: how the map is laid onto the truth first; objects are aligned by their matches, the path by itself.
        radius: m, the largest distance of a match; only objects of one label are matched.
    Raises:
        LogError: there is no truth to compare with.
        ConfigError: the radius is not positive.
    """
    _check_radius(radius)
    pairs = None
    if trajectory is not None and truth is not None and truth.trajectory is not None:
        pairs = _path_pairs(trajectory, truth.trajectory)
    if truth is None or (not truth.objects and pairs is None):
        raise LogError("no ground truth", hint="give --truth FILE")
    on_path = IDENTITY if pairs is None else Transform(*align_points(*pairs, align))
    objects = path = None
    if truth.objects:
        start = on_path if pairs is not None and len(pairs[0]) >= 2 else None
        objects = _score_objects(map, truth.objects, align, radius, start)
    if trajectory is not None and pairs is not None:
        ours, theirs = pairs
        with_map = None if objects is None else _distances(objects.transform.apply(ours), theirs)
        path = PathScores(_distances(on_path.apply(ours), theirs), with_map, len(trajectory) - len(ours), on_path)
    return Evaluation(objects, path, align, radius, tuple(_warnings(objects, path, align)))


def evaluate_folder(out: Path, truth: Path | None = None, *, align: Alignment = "none", radius: float = 0.5) -> Evaluation:
    """Compare the result in the folder `out` with the truth in `truth` (as `load_truth` finds it), else with its log's.

    Raises:
        LogError: there is no truth; the message names where it was looked for.
        OutputError: the result cannot be read.
        ConfigError: the radius is not positive.
    """
    _check_radius(radius)
    map_, path, known = load_map(out), load_trajectory(out), load_truth(truth or out)
    if known is None:
        names = f"{GROUNDTRUTH}/{OBJECTS} or {GROUNDTRUTH}/{TRAJECTORY}"
        if truth is None:
            message, hint = "the log of this result brought no ground truth", "give --truth FILE"
        else:
            message, hint = f"no ground truth here: looked for {names}", "give an objects file or a folder that holds one"
        raise LogError(message, where=str(truth or out), hint=hint)
    if not known.objects and known.trajectory is None:
        raise LogError("the ground truth is empty", where=str(truth or out), hint="give --truth FILE")
    evaluation = evaluate(map_, known, path, align=align, radius=radius)
    return evaluation if truth is None else replace(evaluation, truth=str(truth))


def write_evaluation(evaluation: Evaluation, out: Path) -> None:
    """Write evaluation.json into the result folder `out`; OutputError when the disk refuses."""
    write_file(out / EVALUATION, dump_json(evaluation.to_dict()).encode())


def _check_radius(radius: float) -> None:
    if not radius > 0:
        raise ConfigError(f"the radius must be positive, got {radius}")


def _score_objects(
    map: ObjectMap, truth: tuple[TruthObject, ...], kind: Alignment, radius: float, on_path: Transform | None
) -> ObjectScores:
    # sorted, so that the matches do not depend on the order in the files
    mapped = sorted(map.resolved(), key=lambda o: (o.label, o.id))
    true = sorted(truth, key=lambda o: (o.label, o.id))
    ours, theirs, same = correspondences(mapped, true)
    # where a label repeats, the path, if there is one, says better than the objects how map and truth lie
    repeat = bool((same.sum(axis=0) > 1).any() or (same.sum(axis=1) > 1).any())
    transform = align_objects(ours, theirs, same, radius, kind, start=on_path if repeat else None)
    moved = transform.apply(ours)
    rows, columns = match_points(moved, theirs, same, radius)
    return ObjectScores(
        matches=tuple(Match(mapped[i], true[k], moved[i] - theirs[k]) for i, k in zip(rows, columns, strict=True)),
        missed=tuple(true[k] for k in np.setdiff1d(np.arange(len(true)), columns)),
        false=tuple(mapped[i] for i in np.setdiff1d(np.arange(len(mapped)), rows)),
        unresolved=len(map) - len(mapped),
        transform=transform,
    )


def _warnings(objects: ObjectScores | None, path: PathScores | None, kind: Alignment) -> list[str]:
    warnings = []
    if objects is not None and kind != "none" and 0 < len(objects.matches) < 3:
        warnings.append(f"the alignment rests on {len(objects.matches)} matched objects only: their errors say little")
    if objects is not None and kind == "none" and objects.false and 2 * len(objects.matches) < len(objects.missed):
        warnings.append("hardly an object is where the truth has it: is the map in a frame of its own? then --align se2")
    if objects is not None and not 0.5 <= objects.transform.scale <= 2.0:
        warnings.append(f"the map is scaled by {objects.transform.scale:.3g} to fit the truth: do they show the same place?")
    if path is not None and not len(path.errors):
        warnings.append("no pose of the path has a truth at its stamp: do both use the same clock?")
    return warnings


def _path_pairs(path: Trajectory, truth: Trajectory) -> tuple[Floats, Floats]:
    """Positions (N, 3), m, of the path and of the truth at the same stamps: those of the path that the truth covers."""
    poses, known = interpolate(truth.stamps, truth.poses, path.stamps, MAX_TRUTH_GAP)
    return path.poses[known, :3, 3], poses[known, :3, 3]


def _object_dict(scores: ObjectScores | None) -> dict[str, Any]:
    counts = ("matched", "missed", "false", "unresolved", "precision", "recall")
    if scores is None:
        return {**dict.fromkeys(counts), **_summary("position_", None), "transform": None}
    found = (len(scores.matches), len(scores.missed), len(scores.false), scores.unresolved, scores.precision, scores.recall)
    numbers = dict(zip(counts, found, strict=True))
    return {**numbers, **_summary("position_", scores.errors), "transform": _transform_dict(scores.transform)}


def _path_dict(path: PathScores | None) -> dict[str, Any]:
    ate = _summary("ate_", None if path is None else path.errors)
    with_map = _summary("", None if path is None else path.errors_with_map)
    return {
        "ate": ate.pop("ate_rmse"),
        **ate,
        "ate_in_map_alignment": with_map["rmse"],
        "path_poses": None if path is None else len(path.errors),
        "path_poses_without_truth": None if path is None else path.outside,
        "path_transform": None if path is None else _transform_dict(path.transform),
    }


def _listing(scores: ObjectScores | None) -> dict[str, Any]:
    if scores is None:
        return {"objects": [], "missed_objects": [], "false_objects": []}
    matches = [
        {"id": m.object.id, "truth_id": m.truth.id, "label": m.truth.label, "error": m.error, "offset": m.offset.tolist()}
        for m in scores.matches
    ]
    missed = [{"truth_id": o.id, "label": o.label} for o in scores.missed]
    return {
        "objects": matches,
        "missed_objects": missed,
        "false_objects": [{"id": o.id, "label": o.label} for o in scores.false],
    }


def _distances(a: Floats, b: Floats) -> Floats:
    return np.asarray(np.linalg.norm(a - b, axis=1))


def _share(part: int, rest: int) -> float | None:
    return part / (part + rest) if part + rest else None


def _summary(prefix: str, errors: Floats | None) -> dict[str, float | None]:
    if errors is None or not len(errors):
        return dict.fromkeys((f"{prefix}rmse", f"{prefix}median", f"{prefix}max"))
    rmse = float(np.sqrt((errors**2).mean()))
    return {f"{prefix}rmse": rmse, f"{prefix}median": float(np.median(errors)), f"{prefix}max": float(errors.max())}


def _transform_dict(transform: Transform) -> dict[str, Any]:
    """map to truth: scale * rotation @ point + translation."""
    pose = transform.pose
    yaw = float(np.degrees(np.arctan2(pose[1, 0], pose[0, 0])))
    return {"scale": transform.scale, "yaw_deg": yaw, "translation": pose[:3, 3].tolist()}
