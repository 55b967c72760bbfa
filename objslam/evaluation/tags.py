"""Compare the rotations of fiducials with the true rotations."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from objslam.core.object_map import MapObject
from objslam.core.rotation import rotation_from_quaternion, rotation_vector
from objslam.core.types import TruthObject
from objslam.evaluation.alignment import Transform

_INSIDE_95 = 7.815
"""The squared Mahalanobis distance within which 95 % of rotations lie if their covariances are right (chi-squared, 3 degrees
of freedom)."""


@dataclass(frozen=True)
class TagMatch:
    """The errors of the rotation of a fiducial after the alignment. error: the angle between its first rotation and the true
    rotation, rad. squared: the squared Mahalanobis distance of the rotations. If the fiducial may have a second rotation,
    this is the smaller one of the two distances."""

    error: float
    squared: float


def match_tags(found: MapObject, true: TruthObject, transform: Transform) -> TagMatch | None:
    """Return the errors of the rotation of a fiducial, or None if the map object or the true object has no rotation."""
    if found.tag is None or true.tag_xyzw is None:
        return None
    truth = transform.pose[:3, :3].T @ rotation_from_quaternion(true.tag_xyzw[None])[0]
    turns = [turn for turn in (found.tag.rotation, found.tag.other) if turn is not None]
    off = [rotation_vector((turn.T @ truth)[None])[0] for turn in turns]
    squared = [float(one @ np.linalg.pinv(found.tag.covariance, hermitian=True) @ one) for one in off]
    return TagMatch(float(np.linalg.norm(off[0])), min(squared))


def tag_scores(matches: list[TagMatch]) -> dict[str, float | int | None]:
    """Return the number of compared fiducials, the median and the largest error of their rotations (degrees), and the share
    of true rotations inside the 95 % region."""
    keys = ("tags", "rotation_error_deg_median", "rotation_error_deg_max", "rotation_inside_95")
    if not matches:
        return dict(zip(keys, (0, None, None, None), strict=True))
    error = np.degrees([m.error for m in matches])
    inside = float(np.mean([m.squared <= _INSIDE_95 for m in matches]))
    return dict(zip(keys, (len(matches), float(np.median(error)), float(error.max()), inside), strict=True))
