"""Triangulate objects at fixed camera poses, with the noise of these poses."""

import numpy as np

from objslam.config import Settings
from objslam.core.arrays import Bools, Floats
from objslam.core.types import Association, Keyframes, Rays
from objslam.triangulation.triangulate import Triangulation, triangulate


def triangulate_at(
    map_T_camera: Floats, keyframes: Keyframes, rays: Rays, association: Association, settings: Settings
) -> Triangulation:
    """Triangulate every object by Eq. 1 at the camera poses (K, 4, 4). Localised poses add their noise to the rays."""
    sigma, place = pose_noise(rays, keyframes, settings)
    return _triangulate(map_T_camera, rays, association, settings, sigma, place)


def triangulate_landmarks(
    map_T_camera: Floats, rays: Rays, association: Association, fewest: int, settings: Settings
) -> tuple[Triangulation, Bools]:
    """Triangulate every object at the camera poses (K, 4, 4), and return which objects (N,) can enter a growing graph.

    An object can enter if at least `fewest` rays agree on it. Its rays must also have parallax, or one of them a range.
    """
    found = _triangulate(map_T_camera, rays, association, settings, rays.sigma, 0.0)
    ranged = association.object[np.isfinite(rays.range) & (association.object >= 0)]
    ready = found.ok & (found.counts >= fewest)
    parallax = found.parallax >= np.radians(settings.joint.min_parallax_deg)
    return found, ready & (parallax | (np.bincount(ranged, minlength=association.count) > 0))


def pose_noise(rays: Rays, keyframes: Keyframes, settings: Settings) -> tuple[Floats, float]:
    """Return the angle noise of the rays (R,), rad, and the noise of their origins, m, with the noise of the localisation.

    Keyframes that share a measured pose share its error, so their rays count as one ray.
    """
    share = keyframes.localized_every
    of = settings.localization
    return np.sqrt(rays.sigma**2 + of.yaw**2 * share), float(of.xy * np.sqrt(share))


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
        range_sigma=rays.range_sigma,
        position_sigma=place,
    )
