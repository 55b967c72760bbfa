"""The odometry as a witness against a localisation, before any ray has an object."""

from objslam.config import Settings
from objslam.core.diagnostics import Ledger
from objslam.core.types import Log
from objslam.frontend.bearings import build_rays
from objslam.frontend.keyframes import build_keyframes
from objslam.frontend.shared_errors import shared_errors
from objslam.frontend.turning_clocks import clocks_of_turns
from objslam.mapping.solution import seen_something


def odometry_contradicts(log: Log, settings: Settings) -> bool:
    """Return whether the odometry shows that the localisation errs for seconds, by at least what `localization` says.

    Both paths are compared at the clocks that the turns of the robot show. A localisation that agrees with its settings, and
    a log without odometry, give False.
    """
    if log.odometry is None or log.localization is None:
        return False
    from objslam.graph.calibration.paths_alone import noise_of_paths  # It imports scipy.sparse. Few runs need it.

    joint = settings.model_copy(update={"mode": "joint"})
    frames = build_keyframes(log, joint, Ledger())
    rays = build_rays(log, frames, joint, Ledger())
    errors = shared_errors(log, *seen_something(frames, rays), joint)
    if errors is None or "localization" not in errors.unknown_noise or frames.odom_T_base is None:
        return False
    return max(noise_of_paths(errors, clocks_of_turns(errors)).lasting_factors) >= 1
