"""Compare measured ranges with the distances that bearings alone give, or with the motion by odometry."""

from dataclasses import replace

import numpy as np

from objslam.core.arrays import Bools, Floats
from objslam.core.statistics import grouped_median
from objslam.mapping.checks.agreement import Agreement, Part
from objslam.mapping.checks.finding import Finding

_FEWEST = 40
"""The fewest ranges that are judged. A few ranges show a scale error poorly. A larger number judges fewer logs."""
_POINTS = 4
"""The fewest points whose ranges are judged. A few points may be at wrong positions by chance. A larger number judges fewer
logs."""
_PARALLAX = np.radians(20.0)
"""The least angle (rad) between the rays of a point for a reliable distance. A larger angle leaves fewer points."""
_SPREAD = 0.1
"""The largest median deviation of the factors of single points from their median, as a share. A factor is the ratio of range
to distance. A wrong unit or scale gives all points one factor. Points at wrong positions have different factors. A larger
value also judges such points."""
_SPREAD_OF_UNITS = 0.3
"""The value of `_SPREAD` for a factor that only a wrong unit explains (`_UNIT`). A larger value also judges points at wrong
positions."""
_LEAST = 0.04
"""The least error of the ranges that is reported, as a share of the range. The depth of things, and cameras that are turned
a little, also make errors: up to 0.03 in simulation, and 0.02 on the MRCLAM robots with their true poses. A larger share
warns less often."""
_SPOILING = 0.06
"""The error of the scale from which positions are unreliable, as a share. With a larger share, fewer maps are unreliable."""
_SIGMAS = 5.0
"""The least error of the ranges that is reported, in standard deviations. A larger number warns less often."""
_UNITS = {1000.0: "mm", 100.0: "cm", 3.28084: "feet", 39.37: "inches", 1e-3: "km"}
"""The name of each unit of length, by the number of units in a metre."""
_SCALE = "depth scale"
"""The name of a finding about ranges that are too long or too short, but not in another unit."""
_CLOSE = 0.25
"""The limit on the logarithm of the ratio between a factor and a unit of `_UNITS`. Below it, the factor counts as this unit.
A larger value names more units."""
_UNIT = 0.7
"""The logarithm of a factor above which only a wrong unit explains the factor. No calibration error is that large. A larger
value takes fewer factors for wrong units."""
_GROUP = 8
"""The fewest ranges of a label in a window from which a factor is estimated. Fewer ranges show it poorly. A larger number
leaves fewer factors."""
_ALONE = 1.1
"""The largest crowd (`Part.crowd`) at which all boxes of a label in a window count as boxes of one thing. The ranges then
are tested by whether they end at one point. A larger value tests more logs in this way."""
_LEAST_BY_ODOMETRY = 0.18
"""The least error of the ranges, as a share of the range, that is reported if the poses are from odometry. The joint mode
itself corrects errors of several percent. With a larger value, fewer errors are reported."""
_FACTORS = np.exp(np.linspace(np.log(1 / 5000), np.log(5000), 1200))
"""The tried factors on ranges. More factors find the best one more exactly."""
_TELLS = 0.5
"""The largest spread of the ends of ranges at the right factor, as a share of their spread at the largest factor. Both
spreads are relative to the length of the ranges. At the right factor the ends come together. A smaller share accepts fewer
labels."""


def check_ranges(found: Agreement, part: Part) -> Finding | None:
    """Return a finding if the ranges are too long or too short for the motion of the robot."""
    if not part.drifts:
        return _by_bearings(found)
    if part.crowd <= _ALONE:
        return _by_spread(found, part)
    in_crowd = _by_bearings(found)
    return in_crowd if in_crowd is not None and in_crowd.name != _SCALE else None


def _by_spread(found: Agreement, part: Part) -> Finding | None:
    """Judge ranges with the motion by odometry. Right ranges of a label in a window end at one place.

    Bearings alone give poor positions in a short window, so they are not used.
    """
    rays = found.rays
    origins, directions = rays.in_map(found.keyframes.map_T_camera)
    window = np.array([part.window[camera][frame] for camera, frame in zip(*_frames(found), strict=True)])
    group = rays.label + len(rays.label_names) * window[rays.keyframe]
    factors = []
    for number in np.unique(group[np.isfinite(rays.range)]):
        mine = (group == number) & np.isfinite(rays.range)
        if mine.sum() >= _GROUP:
            factors.append(_best_factor(origins[mine], directions[mine], rays.range[mine]))
    known = np.log([factor for factor in factors if factor > 0])
    if len(known) < _POINTS:
        return None
    ratio = float(np.exp(-np.median(known)))
    most = _SPREAD_OF_UNITS if abs(np.log(ratio)) > _UNIT else _SPREAD
    if np.median(np.abs(known + np.log(ratio))) > most or abs(ratio - 1) < _LEAST_BY_ODOMETRY:
        return None
    said = _in_words(ratio, "the way of the odometry")
    # The odometry may turn too far or too little, and clocks may differ. Both move the ends of ranges as a scale does. A
    # joint solve knows these errors.
    return replace(said, basis="ranges") if said.name == _SCALE else said


def _frames(found: Agreement) -> tuple[list[int], list[int]]:
    return found.keyframes.camera.tolist(), found.keyframes.frame.tolist()


def _best_factor(origins: Floats, directions: Floats, ranges: Floats) -> float:
    """Return the factor on ranges (n,) that brings their ends closest together, relative to their length. 0 if none does."""
    ends = origins + _FACTORS[:, None, None] * (ranges[:, None] * directions)
    spread = np.linalg.norm(ends - np.median(ends, axis=1, keepdims=True), axis=2)
    relative = np.median(spread, axis=1) / (_FACTORS * np.median(ranges))
    best = int(relative.argmin())
    # Only the directions count at very long ranges. If they agree, the robot stood still, and no factor can be found.
    return float(_FACTORS[best]) if relative[best] < _TELLS * relative[-1] and 0 < best < len(_FACTORS) - 1 else 0.0


def _by_bearings(found: Agreement) -> Finding | None:
    """Judge ranges by the positions where bearings meet.

    A range ends on the surface of a thing, and a bearing goes to its centre. So a constant difference is no error. A wrong
    scale changes both the ratio and the growth of the range with the distance.
    """
    rays = found.rays
    held = (found.point >= 0) & np.isfinite(rays.range)
    if held.sum() < _FEWEST:
        return None
    origins, _ = rays.in_map(found.keyframes.map_T_camera)
    held &= _well_placed(found)[np.maximum(found.point, 0)]
    if held.sum() < _FEWEST:
        return None
    owner = found.point[held]
    distance = np.linalg.norm(found.points[owner] - origins[held], axis=1)
    count = len(found.points)
    ratios = grouped_median(rays.range[held] / distance, owner, count)
    known = np.log(ratios[np.isfinite(ratios)])
    ratio = float(np.exp(np.median(known)))
    if len(known) < _POINTS or np.median(np.abs(known - np.median(known))) > _SPREAD:
        return None
    scaled = rays.range[held] / ratio
    miss = np.abs(scaled - distance)
    kept = miss <= 3 * float(np.median(miss)) + 1e-9
    owner, distance, scaled = owner[kept], distance[kept], scaled[kept]
    number = np.maximum(np.bincount(owner, minlength=count), 1)
    d = distance - (np.bincount(owner, distance, minlength=count) / number)[owner]
    r = scaled - (np.bincount(owner, scaled, minlength=count) / number)[owner]
    spread = float((d**2).sum())
    if spread <= 0:
        return None
    slope = float((d * r).sum() / spread)
    sigma = float(np.sqrt(((r - slope * d) ** 2).mean() / spread))
    growth = ratio * slope
    if abs(np.log(ratio)) > _UNIT:
        return _in_words(ratio, "the distances by bearings")
    off = min(abs(ratio - 1), abs(growth - 1))
    if (ratio - 1) * (growth - 1) <= 0 or off < _LEAST or abs(slope - 1 / ratio) < _SIGMAS * sigma:
        return None
    return _in_words(ratio, "the distances by bearings", spoils=off >= _SPOILING)


def _in_words(ratio: float, than: str, *, spoils: bool = True) -> Finding:
    """Return the finding for ranges that are `ratio` times too long, or too short if the ratio is below 1.

    than: what the ranges are compared with, in words. spoils: whether a wrong scale makes positions unreliable. A wrong unit
    always does.
    """
    for factor, unit in _UNITS.items():
        if abs(np.log(ratio / factor)) < _CLOSE:
            return Finding(
                f"depth in {unit}",
                f"the depths are {ratio:.3g} times too long for {than}: they are probably in {unit} instead of m "
                "(depth_scale is the units of a depth image per metre)",
            )
    return Finding(
        _SCALE,
        f"the depths are {100 * abs(ratio - 1):.0f} % too {'long' if ratio > 1 else 'short'} for {than}: "
        "the scale of the depths (depth_scale), the scale of the poses, or the focal length is wrong",
        spoils=spoils,
    )


def _well_placed(found: Agreement) -> Bools:
    """Return which points (N,) are seen under a wide angle."""
    origins, _ = found.rays.in_map(found.keyframes.map_T_camera)
    held = found.point >= 0
    owner = found.point[held]
    to = found.points[owner] - origins[held]
    to = to / np.linalg.norm(to, axis=1, keepdims=True)
    count = len(found.points)
    mean = np.stack([np.bincount(owner, column, minlength=count) for column in to.T], axis=1)
    mean = mean / np.maximum(np.linalg.norm(mean, axis=1, keepdims=True), 1e-9)
    off = np.arccos(np.clip(np.einsum("ri,ri->r", to, mean[owner]), -1.0, 1.0))
    widest = np.zeros(count)
    np.maximum.at(widest, owner, off)
    return np.asarray(widest > _PARALLAX / 2)
