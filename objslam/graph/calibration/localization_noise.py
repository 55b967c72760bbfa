"""Estimate the noise of a localisation, and how long its errors last, from the rest of the log.

Odometry and rays predict the path, up to a shift and a turn of the whole. The localisation differs from this prediction by
the error of the prediction, whose covariance the graph knows, and by its own error. Three values of its own error are
estimated by restricted maximum likelihood (Patterson and Thompson 1971): its size, the share of it that lasts, and how long
this share lasts.
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
"""In the graph that predicts the localised poses, their noise is multiplied by this factor, so that they hardly count. With
a larger factor, the prediction contains less of the localisation, and more rounding errors."""
_FIRST, _LAGS = 18, (0, 1, 2, 4, 8, 16)
"""In a long log, the compared poses are at `_FIRST` keyframes, evenly spread, and `_LAGS` keyframes after each of them.
Poses close together show errors that are new in each pose, and poses far apart show errors that last. More poses are more
exact, and the time grows with the cube of their number."""
_MOST_STRAYS = 0.1
"""At most this share of the poses are jumps. A larger share explains noise by jumps."""
_KEPT = 64
"""For how many logs' paths the noise is kept. A run that compares the same two paths again, as its checks do, then searches
once. A larger number takes more memory, some hundred bytes each."""

_kept = dict[bytes, "_Noise"]()
_lock = Lock()

_Noise = tuple[tuple[float, Lasting], tuple[float, Lasting]]
"""The factors on the noise of headings and places, and their lasting parts."""


def noise_of_localization(rest: Linearised, errors: CalibratedMeasurements, theta: Floats) -> NoiseFactors:
    """Return `errors.noise` with the noise of the localisation that agrees best with the rest of a graph at its values.

    Factors are at least 1. They are 1 if the log agrees with the settings. rest: the graph, `without_localization`. theta:
    (P,) the shared errors. SolveError if the rest is singular.
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
    """Return `errors.noise` with the noise of the localisation that agrees best with the odometry alone, before any ray has
    an object.

    theta: (P,) the shared errors. If the odometry does not determine the path, the noise stays as it is.
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
    """Return the noise of headings and places that agrees best with the data. That of the same data is kept."""
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
    """Return a digest of all values, which is the same for the same data."""
    arrays = (np.ascontiguousarray(one) for one in (data.off, data.covariance, data.shared, data.times))
    rest = repr((data.apart, data.nominal, data.free, data.prior)).encode()
    return sha256(b"".join(one.tobytes() for one in arrays) + rest).digest()


def _without_jumps(data: ComparedPoses, model: PoseErrors) -> Ints:
    """Return the poses (m,) that agree with what all other poses predict, or all poses if too many disagree."""
    inner = np.linalg.inv(data.expected(model))
    n = len(data.times)
    at = np.arange(n)[:, None] + n * np.arange(3)
    blocks, pull = inner[at[:, :, None], at[:, None, :]], (inner @ data.off)[at]
    size = (pull * np.linalg.solve(blocks, pull[..., None])[..., 0]).sum(axis=1)
    near = np.flatnonzero(size < SAME_POINT_WIDE)
    return near if len(near) >= (1 - _MOST_STRAYS) * n else np.arange(n)


def _compared(rest: Linearised, errors: CalibratedMeasurements, theta: Floats) -> ComparedPoses:
    """Return the localisation against a prediction by the rest of the graph, `without_localization`."""
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
    """Return the graph at the same values, in which the localisation hardly counts."""
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
