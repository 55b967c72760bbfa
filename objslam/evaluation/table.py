"""Make the tables of an evaluation for a terminal."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from objslam.evaluation.evaluate import Evaluation

if TYPE_CHECKING:
    from rich.console import RenderableType

_OBJECT_ROWS = (
    ("matched", "matched objects", ""),
    ("missed", "missed objects", ""),
    ("false", "false objects", ""),
    ("unresolved", "unresolved objects (without a position)", ""),
    ("precision", "precision", ""),
    ("recall", "recall", ""),
    ("position_rmse", "position RMSE", " m"),
    ("position_median", "position median", " m"),
    ("position_max", "position max", " m"),
    ("mahalanobis_median", "squared Mahalanobis in x, y, median (honest: 1.39)", ""),
    ("inside_95", "share of truths inside the 95 % ellipse", ""),
    ("inside_95_3d", "share of truths inside the 95 % ellipsoid", ""),
)
_NOT_SHARED = {"mahalanobis_median": "squared Mahalanobis in x, y, median (honest: 1.39 or less)"}
"""Other names of rows, for an aligned map without the covariance of the errors that its objects share. An alignment may
remove such errors, but the covariances still contain them."""
_BODY_ROWS = (
    ("bodies", "bodies compared", ""),
    ("size_error_median", "error of length, width and height as a share, median", ""),
    ("yaw_error_deg_median", "error of the yaw, median", " deg"),
    ("iou_median", "3D overlap (IoU) of the bodies, median", ""),
)
_TAG_ROWS = (
    ("tags", "rotations of fiducials compared", ""),
    ("rotation_error_deg_median", "error of the rotation, median", " deg"),
    ("rotation_error_deg_max", "error of the rotation, max", " deg"),
    ("rotation_inside_95", "share of true rotations inside the 95 % region", ""),
)
"""The rows about objects, and about bodies and fiducials, if there are any: key in evaluation.json, name in the table, and
unit."""

_PATH_ROWS = (
    ("ate", "ATE (RMSE)", " m"),
    ("ate_median", "ATE median", " m"),
    ("ate_max", "ATE max", " m"),
    ("ate_in_map_alignment", "ATE after the objects' alignment", " m"),
    ("path_poses", "poses compared", ""),
    ("path_poses_without_truth", "poses without truth", ""),
)
"""The rows about the path: key in evaluation.json, name in the table, and unit."""


def evaluation_table(evaluation: Evaluation) -> RenderableType:
    """Return a table of the scores, a table of the objects by decreasing error, and the warnings.

    Print it on a console without markup, because labels and file names are not escaped.
    """
    from rich.console import Group
    from rich.table import Table

    data = evaluation.to_dict()
    title = f"alignment {evaluation.align} ({evaluation.why}), radius {evaluation.radius:g} m"
    scores = Table()
    scores.add_column("against the ground truth" if evaluation.truth is None else f"against {evaluation.truth}")
    scores.add_column("value", justify="right")
    rows = (_OBJECT_ROWS if evaluation.objects is not None else ()) + (_PATH_ROWS if evaluation.path is not None else ())
    if evaluation.objects is not None and not evaluation.objects.shared_known:
        rows = tuple((key, _NOT_SHARED.get(key, name), unit) for key, name, unit in rows)
    for key, name, unit in (*rows, *(_BODY_ROWS if data["bodies"] else ()), *(_TAG_ROWS if data["tags"] else ())):
        scores.add_row(name, _cell(data[key], unit))
    parts: list[RenderableType] = [title, scores]
    if evaluation.objects is not None:
        listing = Table(title="objects, the worst first")
        for column in ("object", "truth", "label", "error (m)"):
            listing.add_column(column, justify="left" if column == "label" else "right")
        for m in sorted(evaluation.objects.matches, key=lambda m: -m.error):
            listing.add_row(str(m.object.id), str(m.truth.id), m.object.label, f"{m.error:.3f}")
        for missed in evaluation.objects.missed:
            listing.add_row("-", str(missed.id), missed.label, "missed")
        for false in evaluation.objects.false:
            listing.add_row(str(false.id), "-", false.label, "false")
        parts.append(listing)
    parts += [f"warning: {text}" for text in evaluation.warnings]
    return Group(*parts)


def _cell(value: Any, unit: str) -> str:
    if value is None:
        return "-"
    return f"{value:.3f}{unit}" if isinstance(value, float) else f"{value}{unit}"
