"""Evaluation of a map and a path against the ground truth."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from objslam.core.arrays import Floats
from objslam.core.geometry import align as align_points
from objslam.core.geometry import interpolate, quaternion
from objslam.core.object_map import MapObject, ObjectMap
from objslam.core.trajectory import Trajectory
from objslam.core.types import Truth, TruthObject
from objslam.errors import ConfigError, LogError
from objslam.evaluation.aligned_covariances import aligned_covariances
from objslam.evaluation.alignment import IDENTITY, Alignment, Transform, align_objects, correspondences, match_points
from objslam.evaluation.bodies import BodyMatch, body_scores, match_bodies
from objslam.evaluation.tags import TagMatch, match_tags, tag_scores

MAX_TRUTH_GAP = 1.0
"""The longest gap of the true path in which it is interpolated, s. A pose in a longer gap has no true pose."""
INSIDE_95 = 5.991
"""The squared Mahalanobis distance within which 95 % of the errors in x and y lie if their covariances are right
(chi-squared, 2 degrees of freedom)."""
INSIDE_95_3D = 7.815
"""The squared Mahalanobis distance within which 95 % of the errors in x, y and z lie (chi-squared, 3 degrees of freedom)."""


@dataclass(frozen=True)
class Match:
    """A map object and the true object that it matches. `offset` (3,) is map minus truth, m, after the alignment.

    squared: the squared Mahalanobis distance of the offset in x and y, with the covariance after the alignment
    (`aligned_covariances`). squared_3d: the squared distance in x, y and z. Both are None without a covariance. They are
    also None if the alignment uses too few objects, because hardly any error then remains.
    body: the errors of the body, None if one of the two has no size. tag: the error of the rotation of a fiducial, None if
    one of the two has no rotation.
    """

    object: MapObject
    truth: TruthObject
    offset: Floats
    squared: float | None
    squared_3d: float | None
    body: BodyMatch | None = None
    tag: TagMatch | None = None

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
    shared_known: bool = True
    """Whether the map has the covariance of the errors that its objects share, or was not aligned."""

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
    """The absolute trajectory error (ATE; Sturm et al., IROS 2012) at the timestamps of the path with a true pose."""

    errors: Floats  # The translation errors (N,) in m after the alignment of the path.
    errors_with_map: Floats | None  # Errors (N,) in m after the alignment of the objects; None if no true objects exist.
    outside: int  # The number of timestamps without a true pose.
    transform: Transform  # The alignment of the path with the truth, from map to truth.


@dataclass(frozen=True)
class Evaluation:
    """The evaluation of a result. objects: None without true objects. path: None without a path or without a true path."""

    objects: ObjectScores | None
    path: PathScores | None
    align: Alignment
    radius: float
    warnings: tuple[str, ...] = ()
    truth: str | None = None
    """The path of the ground truth, or None if it is the truth of the log."""
    why: str = "as asked"
    """The reason for the kind of the alignment, as text."""

    def to_dict(self) -> dict[str, Any]:
        """Return the content of evaluation.json. Values are in m and deg. A missing value is None."""
        return {
            "truth": self.truth,
            "align": self.align,
            "align_reason": self.why,
            "radius": self.radius,
            **_object_dict(self.objects),
            **_path_dict(self.path),
            "warnings": list(self.warnings),
            **_listing(self.objects),
        }


_NAMED = 3  # The largest number of labels in a warning. A larger number makes the line longer.


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
        align: the kind of the alignment. Objects are aligned by their matches, and the path by its poses.
        radius: the largest distance of a match, m. Only objects with the same label can match.
    Raises:
        LogError: there is no truth to compare with.
        ConfigError: the radius is not positive.
    """
    check_radius(radius)
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


def check_radius(radius: float) -> None:
    """Raise ConfigError unless the radius of a match is positive."""
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
    judged = kind == "none" or len(rows) >= _fewest(kind)
    left = _covariances_left([mapped[i] for i in rows], map.shared_covariance, transform, kind)
    return ObjectScores(
        matches=tuple(
            _match(mapped[i], true[k], moved[i] - theirs[k], transform, cov if judged else None)
            for i, k, cov in zip(rows, columns, left, strict=True)
        ),
        missed=tuple(true[k] for k in np.setdiff1d(np.arange(len(true)), columns)),
        false=tuple(mapped[i] for i in np.setdiff1d(np.arange(len(mapped)), rows)),
        unresolved=len(map) - len(mapped),
        transform=transform,
        shared_known=kind == "none" or map.shared_covariance is not None,
    )


def _covariances_left(
    found: list[MapObject], shared: Floats | None, transform: Transform, kind: Alignment
) -> list[Floats | None]:
    """Return the covariance (3, 3) of each matched object after the alignment, None for an object without a covariance."""
    spread = [np.zeros((3, 3)) if o.covariance is None else o.covariance for o in found]
    points, covariance = (
        np.array(x).reshape(-1, *shape) for x, shape in (([o.position for o in found], (3,)), (spread, (3, 3)))
    )
    left = aligned_covariances(points, covariance, shared, transform, kind)
    return [None if o.covariance is None else one for o, one in zip(found, left, strict=True)]


def _match(found: MapObject, true: TruthObject, offset: Floats, transform: Transform, covariance: Floats | None) -> Match:
    """Return a match. offset: (3,) m, covariance: (3, 3) m^2. Both are those of the object after the alignment."""
    shape = match_bodies(found, true, transform), match_tags(found, true, transform)
    if covariance is None:
        return Match(found, true, offset, None, None, *shape)
    return Match(found, true, offset, _squared(offset[:2], covariance[:2, :2]), _squared(offset, covariance), *shape)


def _squared(offset: Floats, covariance: Floats) -> float:
    return float(offset @ np.linalg.pinv(covariance, hermitian=True) @ offset)


def _fewest(kind: Alignment) -> int:
    """Return the least number of matched objects for which the errors after an alignment are reliable."""
    return 4 if kind in ("se3", "sim3") else 3


def _some(names: set[str]) -> str:
    """Return the first few names of a set, as text."""
    first = sorted(names)[:_NAMED]
    return ", ".join(first) + (", ..." if len(names) > len(first) else "")


def _warnings(objects: ObjectScores | None, path: PathScores | None, kind: Alignment) -> list[str]:
    warnings = []
    if objects is not None and kind != "none" and 0 < len(objects.matches) < _fewest(kind):
        warnings.append(f"the alignment rests on {len(objects.matches)} matched objects only, so their errors mean little")
    if objects is not None and objects.false and not objects.matches and objects.missed:
        of_map, of_truth = ({o.label for o in group} for group in (objects.false, objects.missed))
        if not of_map & of_truth:
            warnings.append(
                f"the map and the truth have no label in common: {_some(of_map)} in the map, {_some(of_truth)} in the truth"
            )
    elif objects is not None and kind == "none" and objects.false and 2 * len(objects.matches) < len(objects.missed):
        warnings.append("few objects match the truth: if the map has its own frame, use --align se2")
    if objects is not None and not 0.5 <= objects.transform.scale <= 2.0:
        warnings.append(
            f"the map is scaled by {objects.transform.scale:.3g} to fit the truth: check that both show the same place"
        )
    if path is not None and not len(path.errors):
        warnings.append("the truth has no pose at any timestamp of the path: check that both use the same clock")
    return warnings


def _object_dict(scores: ObjectScores | None) -> dict[str, Any]:
    counts = ("matched", "missed", "false", "unresolved", "precision", "recall")
    honest = ("mahalanobis_median", "inside_95", "inside_95_3d")
    if scores is None:
        none = dict.fromkeys((*counts, *honest, *body_scores([]), *tag_scores([])))
        return {**none, **_summary("position_", None), "transform": None}
    found = (len(scores.matches), len(scores.missed), len(scores.false), scores.unresolved, scores.precision, scores.recall)
    numbers = dict(zip(counts, found, strict=True))
    squared = np.array([(m.squared, m.squared_3d) for m in scores.matches if m.squared is not None])
    if len(squared):
        inside = (squared <= [INSIDE_95, INSIDE_95_3D]).mean(axis=0).tolist()
        numbers |= dict(zip(honest, (float(np.median(squared[:, 0])), *inside), strict=True))
    else:
        numbers |= dict.fromkeys(honest)
    bodies = body_scores([m.body for m in scores.matches if m.body is not None])
    tags = tag_scores([m.tag for m in scores.matches if m.tag is not None])
    return {
        **numbers,
        **_summary("position_", scores.errors),
        **bodies,
        **tags,
        "transform": _transform_dict(scores.transform),
    }


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
            "mahalanobis_3d": m.squared_3d,
            **({} if m.body is None else m.body.to_dict()),
            **({} if m.tag is None else {"rotation_error_deg": float(np.degrees(m.tag.error))}),
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
    place = transform.pose[:3, 3].tolist()
    rotation = quaternion(transform.pose[None])[0].tolist()
    return {"scale": transform.scale, "yaw_deg": yaw, "translation": place, "rotation_xyzw": rotation}
