"""Compare the path of a joint solve with the localisation of the log, to find a bent path.

Things of which the boxes show only slices can bend a path. The noise of the localisation is estimated from the same boxes,
so it grows with the bend, and the residuals look usual. The odometry does not depend on boxes. So this module takes the
noise of the localisation from a comparison with the odometry, and judges the distance of the path by this noise."""

import numpy as np

from objslam.config import Settings
from objslam.core.arrays import Floats, Ints
from objslam.core.noise import NoiseFactors
from objslam.core.statistics import WHITE, Lasting
from objslam.frontend.shared_errors import SharedErrors
from objslam.frontend.turning_clocks import clocks_of_turns
from objslam.mapping.checks.finding import Finding
from objslam.mapping.solution import Solution

BENT_PATH = "path off the localisation"
"""The name of the finding that the solved path is bent."""
_SECONDS = 5.0
"""The length (s) of a piece of the path. Each piece is judged by its median distance from the localisation. Clocks and
single jumps disturb shorter pieces. Longer pieces miss short bends."""
_FEWEST = 3
"""The fewest localised poses of a piece that is judged. With fewer poses, a single jump can move the median. With a larger
number, fewer pieces are judged."""
_CHANCE = 1e-3
"""The probability that a right path gets a finding by chance, over all its pieces together. With a larger value, smaller
bends are found, but more right paths get a finding."""
_OF_MEDIAN = np.pi / 2
"""The variance of the median of many values with normal white noise, as a multiple of the variance of their mean."""


def check_bent_path(solution: Solution, errors: SharedErrors | None, settings: Settings) -> Finding | None:
    """Return a finding if the solved path lies further from the localisation for seconds than the localisation errs.

    The test of a piece is on the median of its distances. The square of this median over its variance has a chi-square
    distribution with two degrees of freedom. All pieces share one probability of a false alarm. A right path follows a part
    of the localisation's errors, so its distances are even smaller. errors: the shared errors with all frames, before the
    solve.
    """
    from objslam.graph.factors.localization import localized  # It imports gtsam.

    keyframes = solution.keyframes
    if not keyframes.localized_every:
        return None
    number = localized(keyframes)
    off = (solution.estimate.map_T_base - keyframes.map_T_base)[number, :2, 3]
    carried = np.zeros(len(number)) if keyframes.carried is None else keyframes.carried[number, 1]
    stamps, said = keyframes.stamps[number], settings.localization.xy
    order = np.argsort(stamps, kind="stable")
    stamps, off, carried = stamps[order], off[order], carried[order]
    sigmas, limit = sigmas_of_pieces(stamps, off, carried, said, WHITE)
    if not (sigmas > limit).any():
        return None  # More noise would only make these numbers smaller.
    noise = _own_noise(solution, errors)
    own = said * max(noise.place, 1.0)
    sigmas, limit = sigmas_of_pieces(stamps, off, carried, own, noise.lasting[1])
    if not (far := sigmas > limit).any():
        return None
    worst = np.nanargmax(sigmas)
    piece = _pieces(stamps)
    distance = float(np.linalg.norm(np.median(off[piece == worst], axis=0)))
    return Finding(
        BENT_PATH,
        f"the solved path lies up to {100 * distance:.2g} cm from the localisation, too far for {_SECONDS * far.sum():.0f} "
        f"s in all. The localisation itself errs by {100 * own:.2g} cm, so this is {sigmas[worst]:.1f} standard deviations "
        f"(chance allows {limit:.1f}), near the stamp {stamps[piece == worst][0]:.0f}. The boxes and the localisation "
        "contradict each other there: boxes bend the path, or the localisation errs slowly (--mode fixed keeps its poses)",
        spoils=False,
    )


def sigmas_of_pieces(stamps: Floats, off: Floats, carried: Floats, sigma: float, lasting: Lasting) -> tuple[Floats, float]:
    """Return the distance of each piece from the localisation, in standard deviations, and the largest distance that is
    likely by chance.

    stamps: (n,) s, increasing. off: (n, 2) m, from the localisation to the path. carried: (n,) m^2, the variances of further
    white errors. sigma: m, the noise of the localisation. lasting: the part of this noise that lasts. The distance is NaN
    for a piece with too few poses.
    """
    piece = _pieces(stamps)
    sigmas = np.full(piece.max(initial=-1) + 1, np.nan)
    for k in range(len(sigmas)):
        mine = np.flatnonzero(piece == k)
        if len(mine) < _FEWEST:
            continue
        white = _OF_MEDIAN * (sigma**2 * (1 - lasting.share) + carried[mine].mean()) / len(mine)
        apart = np.abs(stamps[mine, None] - stamps[mine])
        together = np.exp(-apart / max(lasting.seconds, 1e-9)).mean()
        variance = white + sigma**2 * lasting.share * together
        sigmas[k] = np.linalg.norm(np.median(off[mine], axis=0)) / np.sqrt(variance)
    return sigmas, float(np.sqrt(-2 * np.log(_CHANCE / max(int(np.isfinite(sigmas).sum()), 1))))


def _pieces(stamps: Floats) -> Ints:
    """Return the number (n,) of each pose's piece. Pieces without a pose get no number, so a jump of the stamps takes no
    time."""
    return np.unique((stamps - stamps[:1]) // _SECONDS, return_inverse=True)[1]


def _own_noise(solution: Solution, errors: SharedErrors | None) -> NoiseFactors:
    """Return the noise of the localisation that the odometry shows. Without odometry, this is the noise that the solve found
    from the boxes, which hides a bend that lasts."""
    if errors is None or "localization" not in errors.unknown_noise:
        return NoiseFactors()
    if errors.keyframes.odom_T_base is None:
        return solution.estimate.noise or NoiseFactors()
    from objslam.graph.calibration.localization_noise import noise_of_paths  # It imports scipy.sparse. Few runs need it.

    return noise_of_paths(errors, clocks_of_turns(errors))
