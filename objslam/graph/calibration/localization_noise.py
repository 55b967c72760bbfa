"""Estimate the noise of a localisation, and how long its errors last, from the rest of the log.

Odometry and rays predict the path, up to a shift and a turn of the whole path. The localisation differs from this prediction
by its own error and by the error of the prediction. The graph gives the covariance of the error of the prediction. Three
values of the error of the localisation are estimated by restricted maximum likelihood (Patterson and Thompson 1971): its
size, the share of it that lasts, and how long this share lasts.
"""

from dataclasses import replace
from hashlib import sha256
from threading import Lock

import numpy as np

from objslam.config import Settings
from objslam.core.arrays import Floats, Ints
from objslam.core.calibration import CalibratedMeasurements
from objslam.core.geometry import adjoint, inverse
from objslam.core.noise import NoiseFactors
from objslam.core.statistics import SAME_POINT_WIDE, WHITE, Lasting
from objslam.core.types import Association, Keyframes
from objslam.errors import SolveError
from objslam.graph.assembly import Measurements
from objslam.graph.calibration.linearised_graph import Linearised
from objslam.graph.calibration.pose_errors import ComparedPoses, PoseErrors, averaged, most_likely
from objslam.graph.calibration.shared_error_jacobian import linearise
from objslam.graph.factors.localization import localized, sharing
from objslam.graph.multiframes import Multiframes

_LOOSE = 1e4
"""The factor on the noise of localised poses in the graph that predicts them. The factor is large, so that the localised
poses hardly count there. With a larger factor, the prediction contains less of the localisation, and more rounding
errors."""
_FIRST, _LAGS = 18, (0, 1, 2, 4, 8, 16)
"""The number of evenly spread places in a long log at which localised poses are compared, and the lags of the poses compared
at each place. A lag is a number of localised poses. Poses close together show errors that are new in each pose, and poses
far apart show errors that last. With more poses, the noise is more exact, and the time grows with the cube of their
number."""
_MOST_STRAYS = 0.1
"""The largest share of the compared poses that may count as jumps of the localisation. With a larger share, noise is taken
for jumps."""
_KEPT = 64
"""The number of comparisons whose result is kept. So a run that compares the same two paths again, as its checks do,
searches only once. A larger number takes more memory, some hundred bytes for each comparison."""

_kept = dict[bytes, "_Noise"]()
_lock = Lock()

_Noise = tuple[tuple[float, Lasting], tuple[float, Lasting]]
"""The factor on the noise and the lasting part, first of headings, and second of places."""


def noise_of_localization(rest: Linearised, errors: CalibratedMeasurements, theta: Floats) -> NoiseFactors:
    """Return `errors.noise` with the noise of the localisation that agrees best with the rest of the graph.

    The factors on the noise are at least 1. They are 1 if the log agrees with the settings. rest: the graph, as
    `without_localization` returns it. theta: (P,) the shared errors. SolveError if the rest is singular.
    """
    (heading, turned), (place, shifted) = _noise_in(_compared(rest, errors, theta))
    return replace(
        errors.noise,
        heading=heading,
        heading_share=turned.share,
        heading_seconds=turned.seconds,
        place=place,
        place_share=shifted.share,
        place_seconds=shifted.seconds,
    )


def noise_of_paths(errors: CalibratedMeasurements, theta: Floats) -> NoiseFactors:
    """Return `errors.noise` with the noise of the localisation that agrees best with the odometry alone.

    This is for a log whose rays have no objects yet. theta: (P,) the shared errors. If the odometry does not determine the
    path, the noise stays as it is.
    """
    keyframes, rays, settings = errors.at(theta)
    measured = Measurements.of(keyframes, rays, settings, Multiframes.of(errors.keyframes))
    nothing = Association(np.full(len(rays), -1), np.zeros(0, dtype=np.int64))
    used = np.zeros(len(rays), dtype=bool)
    paths = Linearised(measured, nothing, measured.keyframes.map_T_camera, np.zeros((0, 3)), used)
    try:
        return noise_of_localization(without_localization(paths), errors, theta)
    except SolveError:
        return errors.noise


def _noise_in(data: ComparedPoses) -> _Noise:
    """Return the noise of headings and places that agrees best with the data. The result is kept for the same data."""
    key = _digest(data)
    with _lock:
        if key in _kept:
            return _kept[key]
    found = most_likely(data)
    near = _without_jumps(data, found)
    if len(near) < len(data.times):
        data = data.take(near)
        found = most_likely(data, found)
    noise = averaged(data, found)
    with _lock:
        _kept[key] = noise
        if len(_kept) > _KEPT:
            del _kept[next(iter(_kept))]
    return noise


def _digest(data: ComparedPoses) -> bytes:
    """Return a hash of all values of the data. It is the same for the same data."""
    arrays = (np.ascontiguousarray(one) for one in (data.off, data.covariance, data.shared, data.times))
    rest = repr((data.apart, data.nominal, data.free, data.prior)).encode()
    return sha256(b"".join(one.tobytes() for one in arrays) + rest).digest()


def _without_jumps(data: ComparedPoses, model: PoseErrors) -> Ints:
    """Return the indices (m,) of the poses that agree with their prediction by all other poses.

    If too many poses disagree (`_MOST_STRAYS`), all poses are returned.
    """
    inner = np.linalg.inv(data.expected(model))
    n = len(data.times)
    at = np.arange(n)[:, None] + n * np.arange(3)
    blocks, pull = inner[at[:, :, None], at[:, None, :]], (inner @ data.off)[at]
    size = (pull * np.linalg.solve(blocks, pull[..., None])[..., 0]).sum(axis=1)
    near = np.flatnonzero(size < SAME_POINT_WIDE)
    return near if len(near) >= (1 - _MOST_STRAYS) * n else np.arange(n)


def _compared(rest: Linearised, errors: CalibratedMeasurements, theta: Floats) -> ComparedPoses:
    """Return the comparison of localised poses with their prediction by the rest of the graph.

    rest: the graph, as `without_localization` returns it. theta: (P,) the shared errors.
    """
    system, keyframes, nominal = linearise(rest, errors, theta), rest.measured.keyframes, errors.settings.localization
    poses = _poses(keyframes)
    map_T_base = (rest.map_T_camera @ inverse(keyframes.base_T_camera))[poses]
    apart = inverse(keyframes.map_T_base[poses]) @ map_T_base
    place = map_T_base[:, :2, 3] - keyframes.map_T_base[poses, :2, 3]
    off = np.concatenate([np.arctan2(apart[:, 1, 0], apart[:, 0, 0]), place.T.ravel()])
    by_twist = adjoint(keyframes.base_T_camera[poses])
    by_twist = np.concatenate([by_twist[:, 2:3], map_T_base[:, :2, :3] @ by_twist[:, 3:]], axis=1)  # (n, 3, 6)
    columns = 3 * len(rest.landmarks) + 6 * poses[:, None] + np.arange(6)
    select = np.zeros((system.jacobian.shape[1], 3 * len(poses)))
    for part in range(3):
        for axis in range(6):
            select[columns[:, axis], part * len(poses) + np.arange(len(poses))] = by_twist[:, part, axis]
    solved = system.normal.solve(select)
    off = off - solved.T @ (system.jacobian.T @ system.residual)
    covariance = select.T @ solved
    shared = np.zeros_like(covariance)
    if len(theta):
        left = system.left(system.sides)
        told = np.linalg.inv(left.T @ left + np.linalg.inv(errors.prior))
        by_error = solved.T @ (system.jacobian.T @ system.sides)
        shared = by_error @ told @ by_error.T
    if keyframes.carried is not None:
        heading, place = keyframes.carried[poses].T
        shared = shared + np.diag(np.concatenate([heading, place, place]))
    stamps, every = keyframes.stamps, sharing(keyframes)
    return ComparedPoses(
        off=off,
        covariance=(covariance + covariance.T) / 2,
        shared=(shared + shared.T) / 2,
        times=stamps[poses],
        apart=every * float(np.median(np.diff(stamps))) if every > 1 else 0.0,
        nominal=(nominal.yaw, nominal.xy),
        free=errors.settings.finds_localization_noise,
        prior=errors.settings.noise.prior,
    )


def without_localization(of: Linearised) -> Linearised:
    """Return the graph at the same values, but with so much noise of the localisation that it hardly counts."""
    measured = replace(of.measured, keyframes=_white(of.measured.keyframes), settings=_without_places(of.measured.settings))
    return replace(of, measured=measured, known=None)


def _white(keyframes: Keyframes) -> Keyframes:
    return replace(keyframes, pose_noise=(1.0, 1.0), lasting=(WHITE, WHITE))


def _without_places(settings: Settings) -> Settings:
    """Return settings in which the localisation has hardly any weight."""
    of = settings.localization
    return settings.model_copy(update={"localization": of.model_copy(update={"xy": of.xy * _LOOSE, "yaw": of.yaw * _LOOSE})})


def _poses(keyframes: Keyframes) -> Ints:
    """Return the indices of the localised poses that are compared, in increasing order."""
    every = localized(keyframes)
    if len(every) <= _FIRST * len(_LAGS):
        return every
    begin = np.linspace(0, len(every) - 1 - max(_LAGS), _FIRST).astype(np.int64)
    return every[np.unique(begin[:, None] + np.array(_LAGS))]
