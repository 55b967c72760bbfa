"""A world that is flattened along z, so that rays from planar poses have equal noise in all directions.

On uneven ground, planar poses lack roll, pitch and height. So rays have more noise up and down than to the sides.
The map (x, y, z) -> (x, y, k z) keeps lines straight, so rays that meet in the world also meet in the flattened world.
"""

import numpy as np

from objslam.config import Settings
from objslam.core.arrays import Floats
from objslam.core.types import Rays

LEVEL = 1.0
"""The factor on z of a world that is not flattened."""


def flattened_lines(origins: Floats, directions: Floats, scale: float) -> tuple[Floats, Floats, Floats]:
    """Return the origins and unit directions (R, 3) of lines in the flattened world, and the factors (R,) on lengths along
    them. scale: the factor on z."""
    if scale == LEVEL:
        return origins, directions, np.ones(len(directions))
    axes = np.array([1.0, 1.0, scale])
    turned = directions * axes
    length = np.linalg.norm(turned, axis=1)
    return origins * axes, turned / length[:, None], length


def flattened_points(points: Floats, scale: float) -> Floats:
    """Convert points (..., 3), m, from the world to the flattened world."""
    return points if scale == LEVEL else points * np.array([1.0, 1.0, scale])


def raised_points(points: Floats, scale: float) -> Floats:
    """Convert points (..., 3), m, from the flattened world to the world."""
    return points if scale == LEVEL else points / np.array([1.0, 1.0, scale])


def raised_covariances(covariances: Floats, scale: float) -> Floats:
    """Convert covariances (..., 3, 3), m^2, from the flattened world to the world."""
    axes = 1 / np.array([1.0, 1.0, scale])
    return covariances if scale == LEVEL else covariances * axes[:, None] * axes


def noise_of_ground(settings: Settings) -> tuple[float, float]:
    """Return the standard deviation of roll and of pitch, rad, and that of the height, m. Planar poses lack all three.

    Both are 0 if `planar` in the settings has its defaults. The defaults describe a floor, which hardly moves a ray.
    """
    of = settings.planar
    return (0.0, 0.0) if of == type(of)() else (of.tilt, of.z)


def flat_scale(rays: Rays, noise: tuple[float, float], settings: Settings) -> float:
    """Return the factor on z with which rays from planar poses have equal noise in all directions.

    noise: the standard deviations of headings, rad, and of places, m.
    """
    (yaw, place), (tilt, z) = noise, noise_of_ground(settings)
    angle = float(np.median(np.hypot(rays.sigma, yaw))) if len(rays) else 0.0
    scales = [sides / float(np.hypot(sides, more)) for sides, more in ((angle, tilt), (place, z)) if more > 0 and sides > 0]
    return min(scales, default=1.0)
