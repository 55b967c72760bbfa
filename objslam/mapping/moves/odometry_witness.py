"""The odometry as a witness against a localisation, before any ray has an object.

False objects take up a part of the errors of poses, so the rays show too small errors. The odometry knows no objects.
"""

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
"""The least duration (s) of errors that count. Shorter ones may come from a clock. If the clock of the odometry is 0.2 s
late, the errors last as long as a turn, which is 2 to 4 s in recorded drives. A larger value misses shorter errors."""


def odometry_contradicts(log: Log, settings: Settings) -> bool:
    """Return whether the odometry shows that the localisation errs for seconds, by at least the noise in the settings
    `localization`.

    Both paths are compared at the clocks that the turns of the robot show. A localisation that agrees with its settings, and
    a log without odometry at its frames, give False.
    """
    if log.odometry is None or log.localization is None:
        return False
    joint = settings.model_copy(update={"mode": "joint"})
    try:
        frames = build_keyframes(log, joint, Ledger())
    except LogError:  # The odometry has no pose at any frame, so it says nothing. The map at the localisation is there.
        return False
    rays = build_rays(log, frames, joint, Ledger())
    return max(lasting_by_odometry(shared_errors(log, frames, rays, joint))) >= 1


def lasting_by_odometry(errors: SharedErrors | None) -> tuple[float, float]:
    """Compare the localisation with the odometry. Return how large its lasting errors are, as factors on `localization.yaw`
    and `localization.xy`. The factors are 0 without odometry, or if the noise of the localisation is known.

    errors: of all frames, because frames without a box count too.
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
