"""Triangulate objects at fixed camera poses. The noise of a localisation counts as noise of the rays."""

import numpy as np

from objslam.config import Settings
from objslam.core.arrays import Bools, Floats
from objslam.core.types import Association, Keyframes, Rays
from objslam.triangulation.triangulate import Triangulation, triangulate


def triangulate_at(
    map_T_camera: Floats, keyframes: Keyframes, rays: Rays, association: Association, settings: Settings
) -> Triangulation:
    """Triangulate every object by Eq. 1 at camera poses (K, 4, 4). The noise of a localisation adds to the noise of rays."""
    sigma, place = pose_noise(rays, keyframes, settings)
    return _triangulate(map_T_camera, rays, association, settings, sigma, place)


def triangulate_landmarks(
    map_T_camera: Floats, rays: Rays, association: Association, fewest: int, settings: Settings
) -> tuple[Triangulation, Bools]:
    """Triangulate every object at the camera poses (K, 4, 4), and return which objects (N,) can enter a growing graph.

    An object can enter if at least `fewest` rays agree on it. These rays must also have a parallax of at least
    joint.min_parallax_deg, or one ray of the object must have a measured range.
    """
    found = _triangulate(map_T_camera, rays, association, settings, rays.sigma, 0.0)
    ranged = association.object[np.isfinite(rays.range) & (association.object >= 0)]
    ready = found.ok & (found.counts >= fewest)
    parallax = found.parallax >= np.radians(settings.joint.min_parallax_deg)
    return found, ready & (parallax | (np.bincount(ranged, minlength=association.count) > 0))


def pose_noise(rays: Rays, keyframes: Keyframes, settings: Settings) -> tuple[Floats, float]:
    """Return the standard deviations (R,), rad, of ray directions, and one standard deviation, m, of all ray origins.

    Both contain the noise of the localisation (`noise_of_poses`). Without a localisation, only the noise of the rays
    remains.
    """
    yaw, place = noise_of_poses(keyframes, settings)
    return np.hypot(rays.sigma, yaw), place


def noise_of_poses(keyframes: Keyframes, settings: Settings) -> tuple[float, float]:
    """Return the standard deviations of localised poses: of headings, rad, and of places, m. 0 without a localisation.

    Keyframes that share one measured pose share its error, so its variance is multiplied by their number. The noise is from
    the settings, or the larger noise that the log shows.
    """
    share, (yaw, place) = float(np.sqrt(keyframes.localized_every)), keyframes.pose_noise
    return settings.localization.yaw * share * yaw, settings.localization.xy * share * place


def _triangulate(
    map_T_camera: Floats, rays: Rays, association: Association, settings: Settings, sigma: Floats, place: float
) -> Triangulation:
    return triangulate(
        *rays.in_map(map_T_camera),
        association.object,
        association.count,
        sigma,
        settings.triangulation,
        seed=settings.seed,
        ranges=rays.range if np.isfinite(rays.range).any() else None,
        range_sigma=np.hypot(rays.range_sigma, place),
        range_bias=rays.range_bias,
        position_sigma=place,
        judged=association.few_rays,
    )
