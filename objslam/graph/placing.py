"""Objects at camera poses that are taken as they are, with the noise that those bring."""

from __future__ import annotations

import numpy as np

from objslam.config import Settings
from objslam.triangulation import Triangulation, triangulate
from objslam.types import Association, Floats, Keyframes, Rays


def triangulate_at(
    map_T_camera: Floats, keyframes: Keyframes, rays: Rays, association: Association, settings: Settings
) -> Triangulation:
    """Every object by Eq. 1 at the camera poses (K, 4, 4); poses that are localised bring their own noise to the rays."""
    origins, directions = rays.in_map(map_T_camera)
    sigma, place = pose_noise(rays, keyframes, settings)
    return triangulate(
        origins,
        directions,
        association.object,
        association.count,
        sigma,
        settings.triangulation,
        seed=settings.seed,
        ranges=rays.range if np.isfinite(rays.range).any() else None,
        range_sigma=rays.range_sigma,
        position_sigma=place,
    )


def pose_noise(rays: Rays, keyframes: Keyframes, settings: Settings) -> tuple[Floats, float]:
    """The rays' angle noise (R,), rad, and that of their origins, m, with the localisation's own noise in it.

    Keyframes that share a measured pose share its error: their rays count as the one.
    """
    share = keyframes.localized_every
    of = settings.localization
    return np.sqrt(rays.sigma**2 + of.yaw**2 * share), float(of.xy * np.sqrt(share))
