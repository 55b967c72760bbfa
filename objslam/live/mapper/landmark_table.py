"""The table of landmarks, with their covariances, their noise, and the landmarks that a camera should see.

The centre of a box is not the image of the object's centre. For large objects nearby, this error would bend the path of the
session. So the landmark of such an object is the centre of the object's body. The boxes of a frame are matched with the
centres of predicted boxes. The bearings of matched boxes are then turned to the centres of bodies.
"""

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from objslam.association.landmarks import PredictedLandmarks
from objslam.association.observations import UsualSizes
from objslam.core.arrays import Bools, Floats, Ints
from objslam.core.bodies.box_centres import beside_centres, image_axes
from objslam.core.camera import Camera
from objslam.core.camera import in_view as in_image
from objslam.core.statistics import NOISE_FACTORS, POOLED_WITH_PROMISE
from objslam.live.mapper.tables import GrowingTable, column
from objslam.live.mapper.tracks import Track

_FLOOR = 0.01  # The standard deviation (m) added to each position. A larger value keeps old landmarks less certain.
_HELD = 1e-4  # Information (m^-2) that keeps covariances of parallel rays finite. A larger one makes them too small.
_INNER = 0.05  # The border where boxes may be cut off, as a share of the image. A larger share expects fewer landmarks.
_NEAREST = 0.3
"""The distance (m) below which an object does not fit into the image. A frame is not expected to show a nearer landmark.
With a larger distance, fewer landmarks are expected."""
_FURTHER = 1.1  # Landmarks are expected up to this factor times their `far`. A larger factor counts more misses.
_NO_ID = -2  # The id of every track among the predicted landmarks. No landmark has this id, and -1 means no landmark.


class LandmarkTable(GrowingTable):
    """The landmarks in the order of their ids.

    position: m, in map. information: m^-2, of the position, from the rays. drift: odometry drift at the last observation.
    first, last: stamps, s, of the first and last observation. label: number of the label. seen: number of frames that showed
    the landmark. expected: number of frames that should have shown it. far: m, the largest observed distance. squared: sum
    of the squared normalised residuals of its rays, clipped. rejected: number of its rays outside the gate.

    sized, ln_size, size_variance: the number of the landmark's boxes and their usual size, as in `UsualSizes`. measured,
    measured_at: the values of `seen` and `position` when the usual size was last measured.

    shape: the shape of the body to whose centre the bearings point, as an index into `core.bodies.body.SHAPES`. 0 means that
    the bearings point to the centres of boxes. half: m, the half axes of this body. yaw: rad, its heading. shape_covariance:
    the covariance of `half` and `yaw`.
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
    sized: Ints = column(np.int64)
    ln_size: Floats = column(np.float64, 2)
    size_variance: Floats = column(np.float64, 2)
    measured: Ints = column(np.int64)
    measured_at: Floats = column(np.float64, 3)
    shape: Ints = column(np.int64)
    half: Floats = column(np.float64, 3)
    yaw: Floats = column(np.float64)
    shape_covariance: Floats = column(np.float64, 4, 4)


def noise(landmarks: LandmarkTable, rows: Ints) -> Floats:
    """Return a factor (n,) for each landmark: the noise of its rays by their residuals, divided by their nominal noise."""
    seen = landmarks.seen[rows] + POOLED_WITH_PROMISE
    return np.sqrt((landmarks.squared[rows] / 2 + POOLED_WITH_PROMISE) / seen).clip(*NOISE_FACTORS)


def covariances(landmarks: LandmarkTable, rows: Ints) -> Floats:
    """Return the covariances (n, 3, 3), m^2, of landmarks, as if all camera poses were known exactly."""
    return np.linalg.inv(landmarks.information[rows] + _HELD * np.eye(3)) + _FLOOR**2 * np.eye(3)


def in_view(
    landmarks: LandmarkTable, camera: Camera, map_T_camera: Floats, margin: float = _INNER, reach: float = 0.0
) -> Bools:
    """Return which landmarks (N,) a camera should see. Such a landmark is in the image, and not much further away than its
    furthest observation.

    map_T_camera: (4, 4). margin: the share of the image along its edge that is excluded. A negative margin extends the
    image. reach: m, the distance up to which every landmark should be seen.
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
    """Return the candidates for the boxes of the next frame: all landmarks, then all tracks."""
    count, more = len(landmarks.id), len(tracks)
    every = np.arange(count)
    label = [-1 if t.by_label else t.label for t in tracks]
    # np.array takes five times as long as np.concatenate for a list of small arrays.
    place = np.concatenate([np.zeros(0), *(t.position for t in tracks)]).reshape(-1, 3)
    spread = np.concatenate([np.zeros((0, 3)), *(t.covariance for t in tracks)]).reshape(-1, 3, 3)
    drift = np.concatenate([np.zeros((0, 6)), *(t.drift for t in tracks)]).reshape(-1, 6, 6)
    return PredictedLandmarks(
        landmarks=count,
        id=np.concatenate([landmarks.id, np.full(more, _NO_ID)]),
        label=np.concatenate([landmarks.label, np.array(label, dtype=np.int64)]),
        position=np.concatenate([landmarks.position, place]),
        covariance=np.concatenate([covariances(landmarks, every), spread]),
        drift=np.concatenate([landmarks.drift, drift]),
        noise=np.concatenate([noise(landmarks, every), np.ones(more)]),
        sizes=_sizes(landmarks, more),
        far=float(landmarks.far.max(initial=0.0)),
    )


def _sizes(landmarks: LandmarkTable, more: int) -> UsualSizes:
    """Return the sizes of the boxes of all landmarks, followed by `more` entries without a size."""
    columns = landmarks.sized, landmarks.ln_size, landmarks.size_variance
    return UsualSizes(*(np.concatenate([values, np.zeros((more, *values.shape[1:]), values.dtype)]) for values in columns))


def box_centres(
    landmarks: LandmarkTable, rows: Ints, cameras: Sequence[Camera], camera: Ints, map_T_camera: Floats
) -> tuple[Floats, Floats]:
    """Return vectors (n, 3), m, from landmarks to points on the rays through the centres of their boxes. The second array
    (n,), m, is the noise of these vectors.

    The noise comes from the bodies. A landmark without a body has the vector 0. rows: (n,) the rows of the landmarks.
    camera: (n,) the number of the camera for each landmark. map_T_camera: (n, 4, 4).
    """
    beside, sigma = np.zeros((len(rows), 3)), np.zeros(len(rows))
    some = np.flatnonzero(landmarks.shape[rows])
    if len(some):
        at = rows[some]
        to = landmarks.position[at] - map_T_camera[some, :3, 3]
        fisheye = np.array([c.fisheye for c in cameras])[camera[some]]
        axes = image_axes(map_T_camera[some, :3, :3], to, fisheye)
        body = landmarks.half[at], landmarks.yaw[at], landmarks.shape[at], landmarks.shape_covariance[at]
        beside[some], sigma[some] = beside_centres(axes, to, *body)
    return beside, sigma


def at_box_centres(predicted: PredictedLandmarks, beside: Floats, sigma: Floats) -> PredictedLandmarks:
    """Return the candidates for the boxes of a frame, with each landmark moved to where the centre of its box would be.

    beside: (N, 3) m and sigma: (N,) m, of all landmarks, as `box_centres` returns them.
    """
    if not beside.any():
        return predicted
    some = np.flatnonzero(beside.any(axis=1))
    position, covariance = predicted.position.copy(), predicted.covariance.copy()
    position[some] += beside[some]
    covariance[some] += (sigma[some] ** 2)[:, None, None] * np.eye(3)
    return replace(predicted, position=position, covariance=covariance)


def to_centres(to: Floats, beside: Floats, sigma: Floats, map_R_camera: Floats) -> tuple[Floats, Floats]:
    """Return vectors (n, 3) to add to unit bearings through centres of boxes, so that the bearings point to the centres of
    bodies.

    The vectors are in the camera frame. The second array (n,) is the noise of the vectors, rad. to: (n, 3) m, from the
    camera to each landmark. beside: (n, 3) m and sigma: (n,) m, as `box_centres` returns them. map_R_camera: (n, 3, 3) or
    (3, 3).
    """
    away, shown = np.sqrt((to * to).sum(axis=1)), to + beside
    added = to / away[:, None] - shown / np.sqrt((shown * shown).sum(axis=1))[:, None]
    return (added[:, None] @ map_R_camera)[:, 0], sigma / away
