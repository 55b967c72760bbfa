"""Find which measurement of a localisation gave the pose of each keyframe.

The poses of a localisation may be rarer than the images, as those of AMCL are. Or the localisation follows the odometry
between two corrections, as the transform of AMCL from map to odometry does. In both cases, one measurement gives the poses
of several keyframes. These poses share one error. The odometry carries the measured pose to the keyframes.
"""

from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np

from objslam.config import Settings
from objslam.core.arrays import Bools, Floats
from objslam.core.geometry import adjoint, interpolate, inverse
from objslam.core.rotation import rotation_vector
from objslam.core.trajectory import Trajectory, poses_near
from objslam.core.types import Keyframes, Log
from objslam.frontend.localization.continued_localization import beside, bridged
from objslam.frontend.odometry_drift import gathered_drift

_STEP = 1e-3
"""The move (m) or turn (rad), beyond that of the odometry, by which a localisation shows that it was corrected. A larger
value misses small corrections. A smaller value takes the rounding of poses and stamps for corrections. AMCL's corrections
are centimetres."""
_FEWEST, _MOST = 10, 0.5
"""The least number of corrections, and the largest share of the poses that are corrections, if a localisation follows the
odometry between corrections. With fewer corrections, a localisation is as exact as the odometry, or was made from the
odometry. A larger `_FEWEST` needs longer logs. A larger `_MOST` takes more localisations for ones that follow the
odometry."""
_RARE = 1.2
"""The number of keyframes for each pose of the localisation above which the odometry carries the poses to the keyframes.
With fewer keyframes, poses are interpolated, which does not need the odometry. A larger number interpolates over longer
times."""


def with_measurements(keyframes: Keyframes, log: Log, measured: Trajectory, settings: Settings) -> Keyframes:
    """Return keyframes at poses of the localisation of a log, with the measurements that gave these poses.

    measured: the localisation before `continued_by_odometry`.
    """
    stamps, max_gap, localization = keyframes.stamps, settings.poses.max_gap, log.localization
    assert localization is not None
    on_path = np.ones(len(stamps), dtype=bool)
    between = ~on_path
    if measured is not localization:
        on_path = interpolate(measured.stamps, measured.poses, stamps, max_gap)[1]
        if log.odometry is not None:
            between = bridged(measured, log.odometry, stamps, settings) & ~on_path
            if not (on_path | between).any():  # A lone pose has no neighbour to which it could be joined.
                between = beside(measured, log.odometry, stamps, settings)
    used = stamps[on_path | between]
    number = ((measured.stamps >= used[0]) & (measured.stamps <= used[-1])).sum() if len(used) else 0
    keyframes = replace(keyframes, localized_every=max(1.0, len(used) / max(float(number), 1.0)))
    if log.odometry is None or keyframes.odom_T_base is None:
        return keyframes
    localized_at = _measured_at(measured, log.odometry, keyframes, max_gap)
    if localized_at is None and on_path.all():
        return keyframes
    localized_at = np.where(on_path, stamps, np.nan) if localized_at is None else localized_at
    localized_at = np.where(between, _nearest(measured.stamps, stamps), localized_at)
    localized_at = np.where(on_path | between, localized_at, np.nan)
    on_odometry = partial(poses_near, log.odometry, max_gap=max_gap)
    odom_T_base = inverse(log.odometry.poses[0]) @ on_odometry(stamps)
    drift = (gathered_drift(log.odometry, at, settings.odometry) for at in (stamps, localized_at))
    return replace(
        keyframes,
        map_T_base=carried_by_odometry(keyframes.map_T_base, stamps, localized_at, localization, on_odometry, max_gap),
        localized_at=localized_at,
        carried=carried_variance(odom_T_base, *drift),
    )


def _measured_at(localization: Trajectory, odometry: Trajectory, keyframes: Keyframes, max_gap: float) -> Floats | None:
    """Return the stamps (K,), s, of the measurements that gave the poses of keyframes. None if each pose was measured by
    itself. A pose counts as measured at its own stamp if no odometry leads to it from a measurement."""
    at, covered = interpolate(odometry.stamps, odometry.poses, localization.stamps, max_gap)
    stamps, known = keyframes.stamps, localization.stamps[covered]
    if len(known) < 2:
        return None
    corrected = known[_corrected(localization.poses[covered], at[covered])]
    if _FEWEST <= len(corrected) <= _MOST * len(known):
        known = corrected
    elif keyframes.localized_every <= _RARE:
        return None
    found = _nearest(known, stamps)
    gap_ends = odometry.stamps[1:][np.diff(odometry.stamps) > max_gap]
    here, there = (np.searchsorted(gap_ends, of, side="right") for of in (stamps, found))
    _, on_odometry = interpolate(odometry.stamps, odometry.poses, stamps, max_gap)
    return np.where((here == there) & on_odometry, found, stamps)


def _nearest(known: Floats, stamps: Floats) -> Floats:
    """Return the nearest of the values `known` (L,), in order, to each of the stamps (Q,)."""
    if len(known) == 1:
        return np.full(len(stamps), known[0])
    after = np.clip(np.searchsorted(known, stamps), 1, len(known) - 1)
    return np.where(stamps - known[after - 1] < known[after] - stamps, known[after - 1], known[after])


def _corrected(map_T_base: Floats, odom_T_base: Floats) -> Bools:
    """Return which poses (n, 4, 4) of a localisation do not follow from the pose before by the odometry (n, 4, 4)."""
    moved, by_odometry = (inverse(poses[:-1]) @ poses[1:] for poses in (map_T_base, odom_T_base))
    more = inverse(by_odometry) @ moved
    size = np.linalg.norm(more[:, :3, 3], axis=1) + np.linalg.norm(rotation_vector(more[:, :3, :3]), axis=1)
    return np.append(True, np.diff(np.floor(np.cumsum(size) / _STEP), prepend=0.0) > 0)


def carried_by_odometry(
    map_T_base: Floats,
    stamps: Floats,
    localized_at: Floats,
    localization: Trajectory,
    on_odometry: Callable[[Floats], Floats],
    max_gap: float,
) -> Floats:
    """Return poses (K, 4, 4) at stamps (K,), s, which the odometry carried from measurements of a localisation.

    map_T_base: (K, 4, 4), which stay for keyframes without a measurement. localized_at: (K,) s, the stamps of the
    measurements, NaN without one. on_odometry: returns the poses of the odometry at stamps. max_gap: s, the longest gap of
    the localisation.
    """
    known, result = np.isfinite(localized_at), map_T_base.copy()
    if not known.any():
        return result
    begin = localized_at[known]
    at = on_odometry(np.concatenate([begin, stamps[known]]))
    result[known] = poses_near(localization, begin, max_gap) @ inverse(at[: len(begin)]) @ at[len(begin) :]
    return result


def carried_variance(odom_T_base: Floats, drift: Floats, drift_at_measured: Floats) -> Floats:
    """Return the variances (K, 2), rad^2 and m^2, of heading and place that the odometry adds on its way from a measurement
    to each keyframe. The variances are 0 without a measurement.

    odom_T_base: (K, 4, 4). drift, drift_at_measured: (K, 6, 6) of the odometry at keyframes and at measurements, NaN at
    keyframes without a measurement.
    """
    to_base = adjoint(inverse(odom_T_base))
    added = np.einsum("kij,kjl,kil->ki", to_base, drift - drift_at_measured, to_base)
    return np.nan_to_num(np.abs(np.column_stack([added[:, 2], added[:, 3:5].mean(axis=1)])))
