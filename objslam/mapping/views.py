"""Compute what the cameras of a drive had in view: all camera frames, at the solved poses."""

from dataclasses import replace

import numpy as np

from objslam.config import Settings
from objslam.core.diagnostics import Ledger
from objslam.core.geometry import interpolate
from objslam.core.trajectory import Trajectory
from objslam.core.types import Keyframes, Log
from objslam.frontend.keyframes import build_keyframes


def solved_views(log: Log, settings: Settings, path: Trajectory) -> Keyframes:
    """Return all camera frames of a log, at the poses of the solved path. path: the solved path. log: without its shared
    errors."""
    if log.localization is None:  # The path is the odometry in both modes, and views need no drift.
        settings = settings.model_copy(update={"mode": "fixed"})
    frames = build_keyframes(log, settings, Ledger())
    at = np.clip(frames.stamps, path.stamps[0], path.stamps[-1])
    return replace(frames, map_T_base=interpolate(path.stamps, path.poses, at, np.inf)[0])
