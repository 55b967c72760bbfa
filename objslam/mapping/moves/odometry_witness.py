"""Compare a localisation with the odometry, before any ray has an object.

False objects take up a part of the errors of poses, so the rays show too small errors. The odometry does not depend on
objects."""

from objslam.config import Settings
from objslam.core.diagnostics import Ledger
from objslam.core.noise import NoiseFactors
from objslam.core.types import Log
from objslam.errors import LogError
from objslam.frontend.bearings import build_rays
from objslam.frontend.keyframes import build_keyframes
from objslam.frontend.known_errors import shared_errors
from objslam.frontend.shared_errors import SharedErrors
from objslam.frontend.turning_clocks import clocks_of_turns

_LONG = 5.0
"""The least duration (s) of errors that count. Shorter errors may come from a clock. If the clock of the odometry is 0.2 s
late, the errors last as long as a turn, which takes 2 to 4 s in recorded drives. With a larger value, shorter errors are
missed."""


def odometry_contradicts(log: Log, settings: Settings) -> bool:
    """Return whether the odometry shows that the localisation errs for seconds, by at least the noise in the settings
    `localization`.

    Both paths are compared at the clock offsets that the turns of the robot show. The result is False if the localisation
    agrees with its settings, or if the log has no odometry at its frames.
    """
    if log.odometry is None or log.localization is None:
        return False
    joint = settings.model_copy(update={"mode": "joint"})
    try:
        frames = build_keyframes(log, joint, Ledger())
    except LogError:  # The odometry has no pose at any frame, so there is nothing to compare.
        return False
    rays = build_rays(log, frames, joint, Ledger())
    return max(lasting_by_odometry(shared_errors(log, frames, rays, joint))) >= 1


def lasting_by_odometry(errors: SharedErrors | None) -> tuple[float, float]:
    """Return the sizes of the localisation's lasting errors, as the odometry shows them. They are factors on
    `localization.yaw` and `localization.xy`. Both are 0 without odometry, or if the noise of the localisation is known.

    errors: the shared errors with all frames, because frames without a box count too.
    """
    if errors is None or "localization" not in errors.unknown_noise or errors.keyframes.odom_T_base is None:
        return 0.0, 0.0
    from objslam.graph.calibration.localization_noise import noise_of_paths  # It imports scipy.sparse. Few runs need it.

    return lasting_long(noise_of_paths(errors, clocks_of_turns(errors)))


def lasting_long(noise: NoiseFactors) -> tuple[float, float]:
    """Return the sizes of the errors that last for `_LONG` or longer, as factors on `localization.yaw` and
    `localization.xy`."""
    turned, moved = (
        factor if lasting.seconds >= _LONG else 0.0
        for factor, lasting in zip(noise.lasting_factors, noise.lasting, strict=True)
    )
    return turned, moved
