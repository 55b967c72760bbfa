"""The landmarks of a session: where they are, how well that is known, and how often they were seen where they should be."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from objslam.association.landmarks import PredictedLandmarks
from objslam.core.arrays import Bools, Floats, Ints
from objslam.core.camera import Camera
from objslam.core.camera import in_view as in_image
from objslam.core.statistics import NOISE_FACTORS, POOLED_WITH_PROMISE
from objslam.live.mapper.tables import GrowingTable, column
from objslam.live.mapper.tracks import Track

_FLOOR = 0.01
"""Standard deviation, m, added to what the rays of a landmark tell; larger keeps old landmarks from being too sure."""
_HELD = 1e-4
"""Information, m^-2, that holds a landmark along rays that all run one way; larger is more than rays themselves tell."""
_INNER = 0.05
"""Share of the image along its edge where a box may be cut off; larger asks fewer landmarks to be seen."""
_NEAREST = 0.3
"""m; what is nearer to the camera does not fit into the image and need not be seen."""
_FURTHER = 1.1
"""Times the greatest distance from which a landmark was seen, it should be seen from; larger makes more misses count."""
_NO_ID = -2
"""The id of a track among the predicted landmarks: it is no landmark's, nor that of none, which is -1."""


class LandmarkTable(GrowingTable):
    """The landmarks, in the order of their ids.

    position: m, in map. information: m^-2, of its rays. drift: the odometry's, gathered when it was last seen. first, last:
    stamps at which it was seen. seen, expected: frames that showed it, and that should have. far: m, the greatest distance
    from which it was seen. squared: the sum of squared deviations of its rays. rejected: rays that did not fit.
    """

    id: Ints = column(np.int64)
    position: Floats = column(np.float64, 3)
    information: Floats = column(np.float64, 3, 3)
    label: Ints = column(np.int64)
    drift: Floats = column(np.float64, 6, 6)
    first: Floats = column(np.float64)
    last: Floats = column(np.float64)
    seen: Ints = column(np.int64)
    expected: Ints = column(np.int64)
    far: Floats = column(np.float64)
    squared: Floats = column(np.float64)
    rejected: Ints = column(np.int64)


def noise(landmarks: LandmarkTable, rows: Ints) -> Floats:
    """By what factor (n,) the rays of landmarks are noisier than promised."""
    seen = landmarks.seen[rows] + POOLED_WITH_PROMISE
    least, most = NOISE_FACTORS
    return np.asarray(
        np.minimum(np.maximum(np.sqrt((landmarks.squared[rows] / 2 + POOLED_WITH_PROMISE) / seen), least), most)
    )


def covariances(landmarks: LandmarkTable, rows: Ints) -> Floats:
    """Covariances (n, 3, 3), m^2, of landmarks from their rays, as if the poses were known."""
    return np.linalg.inv(landmarks.information[rows] + _HELD * np.eye(3)) + _FLOOR**2 * np.eye(3)


def in_view(
    landmarks: LandmarkTable, camera: Camera, map_T_camera: Floats, margin: float = _INNER, reach: float = 0.0
) -> Bools:
    """Which landmarks (N,) should be seen: well inside the image, and from no further than they were seen.

    margin: the share of the image along its edge that does not count; negative, one around it that does. reach: m,
    from how far all of them should be seen, even if they were not.
    """
    local = (landmarks.position - map_T_camera[:3, 3]) @ map_T_camera[:3, :3]
    distance = np.sqrt(np.einsum("ni,ni->n", local, local))
    near = distance < _FURTHER * np.maximum(landmarks.far, reach)
    near &= (distance if camera.fisheye else local[:, 2]) > _NEAREST
    near &= local[:, 2] > distance * math.cos(camera.view_angle if margin >= 0 else camera.lens_angle)
    some = near.nonzero()[0]
    shown, _ = in_image(camera, local[some], margin * camera.size, (1 - margin) * camera.size)
    seen = np.zeros(len(landmarks.id), dtype=bool)
    seen[some[shown]] = True
    return seen


def predict_landmarks(landmarks: LandmarkTable, tracks: Sequence[Track]) -> PredictedLandmarks:
    """What the boxes of the next frame may be of: landmarks and tracks as they are now."""
    count, more = len(landmarks.id), len(tracks)
    every = np.arange(count)
    label = [-1 if t.by_label else t.label for t in tracks]
    place, spread, drift = (
        np.array([getattr(t, name) for t in tracks]).reshape(-1, *shape)
        for name, shape in (("position", (3,)), ("covariance", (3, 3)), ("drift", (6, 6)))
    )
    return PredictedLandmarks(
        landmarks=count,
        id=np.concatenate([landmarks.id, np.full(more, _NO_ID)]),
        label=np.concatenate([landmarks.label, np.array(label, dtype=np.int64)]),
        position=np.concatenate([landmarks.position, place]),
        covariance=np.concatenate([covariances(landmarks, every), spread]),
        drift=np.concatenate([landmarks.drift, drift]),
        noise=np.concatenate([noise(landmarks, every), np.ones(more)]),
        far=float(landmarks.far.max(initial=0.0)),
    )
