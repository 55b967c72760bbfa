"""Evaluation of a map and a path against the ground truth."""

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
"""The true path is interpolated in gaps of at most this length, s. A pose in a longer gap has no true pose."""
INSIDE_95 = 5.991
"""The squared Mahalanobis distance within which 95 % of honest errors lie (chi-squared, 2 degrees of freedom)."""


@dataclass(frozen=True)
class Match:
    """A map object and the true object that it matches. `offset` (3,) is map minus truth, m, after the alignment.

    squared: squared Mahalanobis distance of the offset in x and y, by the covariance of the object. None without one.
    """

    object: MapObject
    truth: TruthObject
    offset: Floats
    squared: float | None

    @property
    def error(self) -> float:
        """Return the distance between the map object and the true object in m."""
        return float(np.linalg.norm(self.offset))


@dataclass(frozen=True)
class ObjectScores:
    """The matched, missed and false objects of a map, and the number of its unresolved objects.

    A match is a map object and a true object of one label within the radius. Each object has at most one match. A missed
    object is a true object without a match, and a false object is a resolved map object without a match. An unresolved
    object has no reliable position, so it is neither matched nor false. `transform` is the alignment from map to truth.
    """

    matches: tuple[Match, ...]
    missed: tuple[TruthObject, ...]
    false: tuple[MapObject, ...]
    unresolved: int
    transform: Transform

    @property
    def errors(self) -> Floats:
        """Return the position errors (matched,) in m."""
        return np.array([m.error for m in self.matches])

    @property
    def precision(self) -> float | None:
        """Return the share of the map objects that are matched, or None for an empty map."""
        return _share(len(self.matches), len(self.false))

    @property
    def recall(self) -> float | None:
        """Return the share of the true objects that are matched, or None without true objects."""
        return _share(len(self.matches), len(self.missed))


@dataclass(frozen=True)
class PathScores:
    """The absolute trajectory error (ATE; Sturm et al., IROS 2012) at those timestamps of the path that have a true pose."""

    errors: Floats  # The translation errors (N,) in m after the alignment of the path.
    errors_with_map: Floats | None  # Errors (N,) in m after the alignment of the objects; None if no true objects exist.
    outside: int  # The number of timestamps without a true pose.
    transform: Transform  # The alignment of the path.


@dataclass(frozen=True)
class Evaluation:
    """The evaluation of a result. `objects` or `path` is None if the ground truth has nothing to compare it with."""

    objects: ObjectScores | None
    path: PathScores | None
    align: Alignment
    radius: float
    warnings: tuple[str, ...] = ()
    truth: str | None = None
    """The path of the ground truth, or None if it is the truth of the log."""

    def to_dict(self) -> dict[str, Any]:
        """Return the content of evaluation.json. Values are in m and deg. A missing value is None."""
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
    """Compare a map with the ground truth, and a path with the true path if both exist.

    Args:
        trajectory: poses map_T_base.
        align: kind of the alignment. Objects are aligned by their matches, and the path by its poses.
        radius: maximum distance of a match in m. Only objects with the same label can match.
    Raises:
        LogError: there is no truth to compare with.
        ConfigError: the radius is not positive.
    """
    _check_radius(radius)
    pairs = None
    if trajectory is not None and truth is not None and truth.trajectory is not None:
        poses, known = interpolate(truth.trajectory.stamps, truth.trajectory.poses, trajectory.stamps, MAX_TRUTH_GAP)
        pairs = trajectory.poses[known, :3, 3], poses[known, :3, 3]
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
    """Compare the result folder `out` with the ground truth at the path `truth` (see `load_truth`).

    By default, the ground truth of the result's log is used. LogError if there is no truth, OutputError if the result cannot
    be read, ConfigError if the radius is not positive.
    """
    _check_radius(radius)
    map_, path, known = load_map(out), load_trajectory(out), load_truth(truth or out)
    if known is None:
        if truth is None:
            raise LogError("the log of this result has no ground truth", where=str(out), hint="give --truth FILE")
        message = f"no ground truth here: looked for {GROUNDTRUTH}/{OBJECTS} or {GROUNDTRUTH}/{TRAJECTORY}"
        raise LogError(message, where=str(truth), hint="give an objects file, or a folder with such a file")
    if not known.objects and known.trajectory is None:
        raise LogError("the ground truth is empty", where=str(truth or out), hint="give --truth FILE")
    evaluation = evaluate(map_, known, path, align=align, radius=radius)
    return evaluation if truth is None else replace(evaluation, truth=str(truth))


def write_evaluation(evaluation: Evaluation, out: Path) -> None:
    """Write evaluation.json into the result folder `out`. OutputError if the file cannot be written."""
    write_file(out / EVALUATION, dump_json(evaluation.to_dict()).encode())


def _check_radius(radius: float) -> None:
    if not radius > 0:
        raise ConfigError(f"the radius must be positive, got {radius}")


def _score_objects(
    map: ObjectMap, truth: tuple[TruthObject, ...], kind: Alignment, radius: float, on_path: Transform | None
) -> ObjectScores:
    # Sorted objects make the matches independent of the order in the files.
    mapped = sorted(map.resolved(), key=lambda o: (o.label, o.id))
    true = sorted(truth, key=lambda o: (o.label, o.id))
    ours, theirs, same = correspondences(mapped, true)
    # If a label repeats, the path gives a better initial alignment than the objects.
    repeat = bool((same.sum(axis=0) > 1).any() or (same.sum(axis=1) > 1).any())
    transform = align_objects(ours, theirs, same, radius, kind, start=on_path if repeat else None)
    moved = transform.apply(ours)
    rows, columns = match_points(moved, theirs, same, radius)
    return ObjectScores(
        matches=tuple(
            _match(mapped[i], true[k], moved[i] - theirs[k], transform) for i, k in zip(rows, columns, strict=True)
        ),
        missed=tuple(true[k] for k in np.setdiff1d(np.arange(len(true)), columns)),
        false=tuple(mapped[i] for i in np.setdiff1d(np.arange(len(mapped)), rows)),
        unresolved=len(map) - len(mapped),
        transform=transform,
    )


def _match(found: MapObject, true: TruthObject, offset: Floats, transform: Transform) -> Match:
    """A match with its offset (3,) after the alignment, and the offset in units of the object's own covariance."""
    if found.covariance is None:
        return Match(found, true, offset, None)
    turn = transform.scale * transform.pose[:3, :3]
    covariance = (turn @ found.covariance @ turn.T)[:2, :2]
    return Match(found, true, offset, float(offset[:2] @ np.linalg.pinv(covariance, hermitian=True) @ offset[:2]))


def _warnings(objects: ObjectScores | None, path: PathScores | None, kind: Alignment) -> list[str]:
    warnings = []
    if objects is not None and kind != "none" and 0 < len(objects.matches) < 3:
        warnings.append(f"the alignment rests on {len(objects.matches)} matched objects only, so their errors mean little")
    if objects is not None and kind == "none" and objects.false and 2 * len(objects.matches) < len(objects.missed):
        warnings.append("few objects match the truth: if the map has its own frame, use --align se2")
    if objects is not None and not 0.5 <= objects.transform.scale <= 2.0:
        warnings.append(
            f"the map is scaled by {objects.transform.scale:.3g} to fit the truth: check that both show the same place"
        )
    if path is not None and not len(path.errors):
        warnings.append("no pose of the path has a truth at its timestamp: check that both use the same clock")
    return warnings


def _object_dict(scores: ObjectScores | None) -> dict[str, Any]:
    counts = ("matched", "missed", "false", "unresolved", "precision", "recall")
    honest = ("mahalanobis_median", "inside_95")
    if scores is None:
        return {**dict.fromkeys((*counts, *honest)), **_summary("position_", None), "transform": None}
    found = (len(scores.matches), len(scores.missed), len(scores.false), scores.unresolved, scores.precision, scores.recall)
    numbers = dict(zip(counts, found, strict=True))
    squared = [m.squared for m in scores.matches if m.squared is not None]
    median, inside = (float(np.median(squared)), float(np.mean(np.array(squared) <= INSIDE_95))) if squared else (None, None)
    numbers |= dict(zip(honest, (median, inside), strict=True))
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
        {
            "id": m.object.id,
            "truth_id": m.truth.id,
            "label": m.truth.label,
            "error": m.error,
            "offset": m.offset.tolist(),
            "mahalanobis": m.squared,
        }
        for m in scores.matches
    ]
    return {
        "objects": matches,
        "missed_objects": [{"truth_id": o.id, "label": o.label} for o in scores.missed],
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
    yaw = float(np.degrees(np.arctan2(transform.pose[1, 0], transform.pose[0, 0])))
    return {"scale": transform.scale, "yaw_deg": yaw, "translation": transform.pose[:3, 3].tolist()}
