"""Check whether the depths of boxes are depths along the optical axis, or distances along the ray."""

import numpy as np

from objslam.core.arrays import Floats, Ints
from objslam.core.object_map import ObjectMap
from objslam.core.statistics import NORMAL_MEDIAN
from objslam.core.types import Association, Keyframes, Rays
from objslam.mapping.checks.finding import Finding
from objslam.mapping.checks.residuals import held_rays

_LEAST = 0.6
"""The least power of the cosine, as an absolute value, that is reported. Right depths have the power 0. The power is 1 or -1
if depths along the optical axis are taken for distances along the ray, or the reverse. A joint solve bends the map towards
the depths, which makes the power a little less. On 11 real and simulated logs it was at most 0.05 for right depths, and 0.81
to 1.07 for wrong ones. A larger value reports fewer logs."""
_SIGMAS = 5.0
"""The least difference between the power and 0, in standard deviations. With a larger number, more depths are needed."""
_FEWEST = 30
"""The fewest depths for a check. With fewer depths, the spread of the visits is not known."""
_VISIT = 3.0
"""The duration (s) of a visit. The errors of an object's depths in one visit count as one error. With a longer duration, a
drive has fewer visits, and the fitted power of the cosine is less certain."""
_ROUNDS = 15
"""The number of rounds of the robust fit. The fit settles within a few rounds."""
_FAR = 1.5
"""The deviation above which a depth counts less (Huber), in standard deviations. A larger number trusts strays more."""


def check_depth_axis(
    objects: ObjectMap, map_T_camera: Floats, keyframes: Keyframes, rays: Rays, association: Association
) -> Finding | None:
    """Return a finding if the depths of a solved map grow or shrink with the cosine of the angle from the optical axis.

    A depth image holds distances along the optical axis. A laser or a person measures distances along the ray. If the two
    kinds are confused, depths near the edge of the image are wrong by the factor cosine: 13 % at 30 degrees. The fitted
    model is log(range / distance) = power * log(cosine) + constant, with one constant for each object. The constant absorbs
    the scale of the map, and errors that all depths of an object share.

    map_T_camera: (K, 4, 4) the solved poses of the cameras at the keyframes.
    """
    power, sigma = _power(objects, map_T_camera, keyframes, rays, association)
    if abs(power) < _LEAST or abs(power) < _SIGMAS * sigma:
        return None
    if power < 0:
        what, wrong = "distances along the ray", "long"
        remedy = "multiply them by the cosine of the angle between the ray and the axis"
    else:
        what, wrong = "depths that were multiplied by the cosine of their angle from the optical axis", "short"
        remedy = "give them as the sensor measured them"
    return Finding(
        "depth axis",
        f"the depths of boxes look like {what}: near the edge of the image they are too {wrong}, by the cosine of the "
        f"angle from the optical axis (to the power {abs(power):.2f} +- {sigma:.2f}). A depth is the distance along the "
        f"optical axis; {remedy}",
        spoils=False,
    )


def _power(
    objects: ObjectMap, map_T_camera: Floats, keyframes: Keyframes, rays: Rays, association: Association
) -> tuple[float, float]:
    """Return the power of the cosine in the depths, and its standard deviation. (0, inf) if there are too few depths."""
    held = np.flatnonzero(held_rays(objects, association) & (rays.range > 0) & (rays.direction[:, 2] > 0))
    if len(held) < _FEWEST:
        return 0.0, np.inf
    owner, frame = association.object[held], rays.keyframe[held]
    positions = np.array([np.full(3, np.nan) if one.position is None else one.position for one in objects.objects])
    distance = np.linalg.norm(positions[owner] - map_T_camera[frame, :3, 3], axis=1)
    longer, cosine = np.log(rays.range[held] / distance), np.log(rays.direction[held, 2])
    weight, power = np.ones(len(held)), 0.0
    for _ in range(_ROUNDS):
        x, y = _without_means(cosine, weight, owner), _without_means(longer, weight, owner)
        power = float((weight * x * y).sum() / max((weight * x * x).sum(), 1e-12))
        left = np.abs(y - power * x)
        spread = max(float(np.median(left)) / NORMAL_MEDIAN, 1e-9)
        weight = 1 / np.maximum(1.0, left / (_FAR * spread))
    visit = np.unique(np.stack([owner, keyframes.stamps[frame] // _VISIT]), axis=1, return_inverse=True)[1].ravel()
    pull = np.bincount(visit, weight * x * (y - power * x))
    return power, float(np.sqrt((pull**2).sum()) / max((weight * x * x).sum(), 1e-12))


def _without_means(values: Floats, weight: Floats, owner: Ints) -> Floats:
    """Return the values (H,), each minus the weighted mean of all values with its owner. weight, owner: (H,)."""
    mean = np.bincount(owner, weight * values) / np.maximum(np.bincount(owner, weight), 1e-12)
    return np.asarray(values - mean[owner])
