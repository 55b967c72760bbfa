"""Estimate the noise of given poses from the boxes, where the settings do not say it.

Poses from GPS err by metres, those of a laser scanner by centimetres. With too little noise, the rays of one object pass
each other. So the association runs with larger noise, and the noise with the highest odds over stray boxes is taken.
"""

from __future__ import annotations

import math

from objslam.config import Settings
from objslam.core.camera import Camera
from objslam.core.diagnostics import Ledger
from objslam.core.types import Association, Keyframes, Rays
from objslam.mapping.fixed_poses import FixedPoses
from objslam.mapping.solution import seen_something

_ENOUGH = 0.5
"""Noise is not estimated if at least this share of the boxes is explained. A larger share estimates it more often."""
_NOISES = (0.1, 0.2, 0.4, 0.8, 1.6, 3.2)
"""The standard deviations (m) that are tried. Steps of 2 are fine, because the odds change little within a factor of 1.5."""
_LEAD = 10.0
"""The least lead in log odds of another noise over that of the settings. A larger lead changes fewer logs."""


def with_pose_noise(
    frames: Keyframes,
    rays: Rays,
    cameras: tuple[Camera, ...],
    settings: Settings,
    association: Association,
    ledger: Ledger,
) -> Settings:
    """Return the settings with the localization.xy that explains the boxes best. Settings that say it stay as they are.

    frames, rays: all keyframes and rays of a log in fixed mode. association: with the settings. If it explains enough boxes,
    the settings fit.
    """
    told = "xy" in settings.localization.model_fields_set
    if settings.mode != "fixed" or told or not frames.localized_every or settings.association.method == "by_label":
        return settings
    if (association.object >= 0).mean() >= _ENOUGH:
        return settings
    at = FixedPoses(frames, rays, *seen_something(frames, rays), cameras, settings)
    best, most = settings, _odds(at.associate()) + _LEAD
    for xy in _NOISES:
        noise = settings.localization.model_copy(update={"xy": xy / math.sqrt(frames.localized_every)})
        other = settings.model_copy(update={"localization": noise})
        odds = _odds(at.with_settings(other).associate())
        if odds > most:
            best, most = other, odds
    if best is not settings:
        ledger.warn(
            f"the poses seem to err by {best.localization.xy:.2g} m instead of {settings.localization.xy:g} m: "
            "with this noise the boxes fit best (localization.xy sets it)"
        )
    return best


def _odds(association: Association) -> float:
    return 0.0 if math.isnan(association.log_odds) else association.log_odds
