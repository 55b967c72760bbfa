"""Which kinds of noise a solve estimates."""

import numpy as np

from objslam.config import Settings
from objslam.core.types import Keyframes, Log, Rays


def unknown_noise(settings: Settings, log: Log, keyframes: Keyframes, rays: Rays) -> frozenset[str]:
    """Return the kinds of noise that are estimated: those that the settings allow, if the log has their measurements.

    The set is empty in fixed mode. Without odometry, only the noise of the localisation is estimated. The duration of the
    localisation's errors is estimated even if the settings give their size.
    """
    default = Settings()
    if settings.mode != "joint":
        return frozenset()
    localized = {"localization"} if keyframes.localized_every and settings.noise.localization is not False else set()
    if keyframes.odom_T_base is None:
        return frozenset(localized)
    ranged = bool(np.isfinite(rays.range).any())
    told = any(one.camera.depth_noise is not None for one in log.cameras)
    kinds = {
        "rays": (settings.noise.rays, settings.rays == default.rays, settings.joint.factor == "bearing"),
        "ranges": (settings.noise.ranges, settings.depth == default.depth and not told, ranged),
        "odometry": (settings.noise.odometry, settings.odometry == default.odometry, True),
    }
    unknown = {k for k, (use, usual, there) in kinds.items() if there and (usual if use == "auto" else use)}
    return frozenset(unknown | localized)
