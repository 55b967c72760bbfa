"""Correct a live map by new values of the shared errors: its path, keyframes, rays, tracks and graph."""

import numpy as np

from objslam.core.arrays import Floats, Ints
from objslam.core.calibration import Calibration
from objslam.core.geometry import inverse
from objslam.core.noise import NoiseFactors
from objslam.core.types import Keyframes, Log
from objslam.frontend.corrected_log import inverse_lens, lens_errors, refocused
from objslam.frontend.odometry_drift import scaled_noise
from objslam.frontend.shared_errors import SharedErrors
from objslam.frontend.surface_ranges import corrected_ranges, measured_ranges, range_factors
from objslam.graph.factors.priors import anchor
from objslam.live.calibration.collected import as_measured, offline_rays, recorded_log
from objslam.live.mapper.localization import chain_keyframes, place_keyframes
from objslam.live.mapper.state import MapState


def recalibrate(m: MapState, calibration: Calibration, noise: NoiseFactors) -> None:
    """Correct the map by a calibration, whose values replace earlier values of its errors.

    The new map depends only on the old map and the arguments, so a resumed session makes the same map. noise: only the
    factors of the localisation are used.
    """
    before = m.errors
    m.errors = before | dict(zip(calibration.names, calibration.values.tolist(), strict=True))
    m.calibration, m.localization.noise = calibration, noise
    m.settings = scaled_noise(m.given, m.errors)
    if not len(m.keyframes):
        return
    m.graph.refresh()
    first = m.keyframe_arrays(np.zeros(1, dtype=np.int64)).map_T_camera[0]
    drifted = m.keyframes.drift.copy()
    times = m.keyframes.stamp.copy()
    _remeasure_keyframes(m)
    rays_changed = _remeasure_rays(m, before)
    drift = _carried(m, drifted)
    _shift_times(m, times)
    if not m.keyframes.localized.any():
        _move_start(m, first)
    _replace_factors(m, rays_changed)
    for track, spread in zip(m.tracks, drift[len(m.landmarks) :], strict=True):
        at = np.searchsorted(m.rays.number, track.numbers())
        track.remeasure(m.rays.direction[at], m.rays.range[at], m.rays.range_sigma[at], spread)
    m.landmarks.drift[:] = drift[: len(m.landmarks)]
    m.pairs.apart.clear()  # Two objects that looked apart by the old noise may be one.
    m.schedule.relinearise_soon()
    m.solve_corrected()


def _remeasure_keyframes(m: MapState) -> None:
    """Correct the cameras, the path, and the stamps, mounts and poses of the keyframes."""
    k = m.keyframes
    every = np.arange(len(k))
    log = recorded_log(m, "live", as_measured(m, every))
    errors, theta = _errors(m, log, as_measured(m, every), every)
    corrected = errors.corrected_log(theta)
    m.cameras[:] = [one.camera for one in corrected.cameras]
    for rows, localized in ((np.flatnonzero(k.localized), True), (np.flatnonzero(~k.localized), False)):
        of = log if localized else Log(log.name, log.cameras, log.odometry)
        if not len(rows) or (of.odometry is None and of.localization is None):
            continue
        one, theta = _errors(m, of, as_measured(m, rows), rows)
        moved = one.at(theta, drift=False)[0]
        k.stamp[rows], k.base_T_camera[rows] = moved.stamps, moved.base_T_camera
        reckoned = localized | k.by_odometry[rows]
        k.map_T_base[rows[reckoned]] = moved.map_T_base[reckoned]
    m.course.recalibrate(m.errors, corrected.odometry, m.settings, k)
    k.camera_T_start[:] = inverse(k.start_T_base @ k.base_T_camera)


def _errors(m: MapState, log: Log, keyframes: Keyframes, rows: Ints) -> tuple[SharedErrors, Floats]:
    """Return the errors that the session corrects, for these keyframes of a log, and their present values (P,)."""
    names, theta = tuple(m.errors), np.array(list(m.errors.values()))
    none = offline_rays(m, np.zeros(0, dtype=np.int64), np.zeros(0, dtype=np.int64))
    return SharedErrors(log, keyframes, none, m.given, names, theta, np.eye(len(names))), theta


def _remeasure_rays(m: MapState, before: dict[str, float]) -> bool:
    """Correct the rays by the new errors instead of the errors `before`. Return whether any ray may have changed."""
    rays, camera = m.rays, m.keyframes.camera[np.searchsorted(m.keyframes.id, m.rays.keyframe)]
    half = m.half_widths(np.arange(len(rays.number)))
    had_factors, has_factors = range_factors(before, half), range_factors(m.errors, half)
    measured = measured_ranges(before, rays.range, rays.direction, had_factors)
    reach = corrected_ranges(m.errors, measured, rays.direction, has_factors)
    changed = not np.allclose(reach, rays.range, rtol=1e-12, equal_nan=True)
    rays.range[:] = reach
    rays.range_sigma[:] *= has_factors / had_factors
    for number, one in enumerate(m.cameras):
        had, has = lens_errors(before, one.name), lens_errors(m.errors, one.name)
        if had != has:
            mine = camera == number
            seen, _ = refocused(rays.direction[mine], inverse_lens(had))
            rays.direction[mine], _ = refocused(seen, has)
            changed = True
    return changed


def _carried(m: MapState, drifted: Floats) -> Floats:
    """Return the drift (N + T, 6, 6) of landmarks and tracks on the corrected course.

    drifted: (K, 6, 6) the drift of the keyframes before the correction. Each object is matched to the first keyframe whose
    old heading drift was at least the object's. The object gets the new drift of this keyframe.
    """
    order = m.time_order()
    passed = np.maximum.accumulate(drifted[order][:, 2, 2])
    had = np.array([*m.landmarks.drift[:, 2, 2], *(track.drift[2, 2] for track in m.tracks)])
    return np.asarray(m.keyframes.drift[order[np.searchsorted(passed, had).clip(max=len(order) - 1)]])


def _shift_times(m: MapState, times: Floats) -> None:
    """Shift the stamps of each landmark and track by the same time as the stamps of the keyframes that saw it.

    times: (K,) s, the stamps of the keyframes before the correction.
    """
    order = np.argsort(times, kind="stable")
    shift = (m.keyframes.stamp - times)[order]

    def shifted(stamps: Floats) -> Floats:
        return np.asarray(stamps + shift[np.searchsorted(times[order], stamps).clip(max=len(order) - 1)])

    m.landmarks.first[:], m.landmarks.last[:] = shifted(m.landmarks.first), shifted(m.landmarks.last)
    for track in m.tracks:
        track.first, track.last = shifted(np.array([track.first, track.last])).tolist()


def _move_start(m: MapState, before: Floats) -> None:
    """Move the whole map, and fix its first keyframe. The map moves as far as the correction moved this keyframe.

    before: (4, 4) map_T_camera of this keyframe before the correction.
    """
    now = m.keyframe_arrays(np.zeros(1, dtype=np.int64)).map_T_camera[0]
    m.graph.drop_absolute()
    m.move(now @ inverse(before))
    m.graph.add_absolute(int(m.keyframes.id[0]), anchor(int(m.keyframes.id[0]), now))


def _replace_factors(m: MapState, rays_changed: bool) -> None:
    """Replace the factors of motions, absolute poses and rays by the factors of the corrected measurements."""
    k, rays = m.keyframes, m.rays
    for number in k.id.tolist():
        m.graph.drop_motion(number)
    chain_keyframes(m)
    place_keyframes(m)
    used = np.flatnonzero(rays.used & (rays.owner >= 0))
    if rays_changed and len(used):
        m.graph.drop_rays(rays.number[used])
        m.graph.add_rays(m.bearings(used))
