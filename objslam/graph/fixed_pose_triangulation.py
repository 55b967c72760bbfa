"""Triangulate objects at fixed camera poses. The noise of a localisation counts as noise of the rays."""

from dataclasses import replace

import numpy as np

from objslam.config import Settings
from objslam.core.arrays import Bools, Floats
from objslam.core.geometry import is_planar
from objslam.core.ground.flattening import (
    LEVEL,
    flat_scale,
    flattened_lines,
    noise_of_ground,
    raised_covariances,
    raised_points,
)
from objslam.core.types import Association, Keyframes, Rays
from objslam.triangulation.triangulate import Triangulation, triangulate


def triangulate_at(
    map_T_camera: Floats, keyframes: Keyframes, rays: Rays, association: Association, settings: Settings
) -> Triangulation:
    """Triangulate every object by Eq. 1 at camera poses (K, 4, 4). The noise of a localisation adds to the noise of rays."""
    return _triangulate(map_T_camera, rays, association, settings, *flat_noise(rays, keyframes, settings))


def triangulate_landmarks(
    map_T_camera: Floats, rays: Rays, association: Association, fewest: int, settings: Settings
) -> tuple[Triangulation, Bools]:
    """Triangulate every object at the camera poses (K, 4, 4), and return which objects (N,) can enter a growing graph.

    An object can enter if at least `fewest` rays agree on it. These rays must also have a parallax of at least
    joint.min_parallax_deg, or one ray of the object must have a measured range.
    """
    found = _triangulate(map_T_camera, rays, association, settings, rays.sigma, 0.0, LEVEL)
    ranged = association.object[np.isfinite(rays.range) & (association.object >= 0)]
    ready = found.ok & (found.counts >= fewest)
    parallax = found.parallax >= np.radians(settings.joint.min_parallax_deg)
    return found, ready & (parallax | (np.bincount(ranged, minlength=association.count) > 0))


def flat_noise(rays: Rays, keyframes: Keyframes, settings: Settings) -> tuple[Floats, float, float]:
    """Return the noise of rays as `pose_noise` does, but as if the ground were even. Also return a factor on z.

    On uneven ground, planar poses have no tilt and no height, so rays have more noise along z. After z is multiplied by the
    factor, the noise of rays is equal in all directions. The factor is `LEVEL` on a flat floor.
    """
    yaw, place = noise_of_poses(keyframes, settings)
    uneven = any(noise_up(keyframes, settings))
    return np.hypot(rays.sigma, yaw), place, flat_scale(rays, (yaw, place), settings) if uneven else LEVEL


def pose_noise(rays: Rays, keyframes: Keyframes, settings: Settings) -> tuple[Floats, float]:
    """Return the standard deviations (R,), rad, of ray directions, and one standard deviation, m, of all ray origins.

    Both contain the noise of the localisation (`noise_of_poses`), and the unknown tilt and height on uneven ground
    (`noise_up`). Without a localisation, only the noise of the rays remains.
    """
    angle, place = largest_noise(keyframes, settings)
    return np.hypot(rays.sigma, angle), place


def largest_noise(keyframes: Keyframes, settings: Settings) -> tuple[float, float]:
    """Return the standard deviations of the rotations (rad) and places (m) of localised poses, along the worst axis."""
    (yaw, place), (tilt, z) = noise_of_poses(keyframes, settings), noise_up(keyframes, settings)
    return float(np.hypot(yaw, tilt)), float(np.hypot(place, z))


def noise_up(keyframes: Keyframes, settings: Settings) -> tuple[float, float]:
    """Return the standard deviations of the tilt (rad, of roll and of pitch) and of the height (m) of the base on uneven
    ground. Localised planar poses do not contain this tilt and height. The standard deviations are 0 for other poses."""
    tilt, z = noise_of_ground(settings)
    if not (tilt or z) or not keyframes.localized_every or not is_planar(keyframes.map_T_base):
        return 0.0, 0.0
    return tilt, z


def noise_of_poses(keyframes: Keyframes, settings: Settings) -> tuple[float, float]:
    """Return the standard deviations of the headings (rad) and places (m) of localised poses, 0 without a localisation.

    Keyframes that share one measured pose share its error. So the variance is multiplied by the number of such keyframes
    that can show one object. The noise is the noise in the settings or the noise that the log shows, whichever is larger.
    """
    if not keyframes.localized_every:
        return 0.0, 0.0
    share, (yaw, place) = float(np.sqrt(max(keyframes.localized_every * keyframes.overlap, 1.0))), keyframes.pose_noise
    return settings.localization.yaw * share * yaw, settings.localization.xy * share * place


def _triangulate(
    map_T_camera: Floats, rays: Rays, association: Association, settings: Settings, sigma: Floats, place: float, scale: float
) -> Triangulation:
    origins, directions, longer = flattened_lines(*rays.in_map(map_T_camera), scale)
    found = triangulate(
        origins,
        directions,
        association.object,
        association.count,
        sigma,
        settings.triangulation,
        seed=settings.seed,
        ranges=rays.range * longer if np.isfinite(rays.range).any() else None,
        range_sigma=np.hypot(rays.range_sigma * longer, place),
        range_bias=rays.range_bias * longer,
        position_sigma=place,
        judged=association.few_rays,
    )
    if scale == LEVEL:
        return found
    raised = raised_points(found.positions, scale), raised_covariances(found.covariance, scale)
    return replace(found, positions=raised[0], covariance=raised[1])
