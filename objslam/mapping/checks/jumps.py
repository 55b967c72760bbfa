"""Test of the jumps of a localisation: do the boxes agree better without them?"""

from dataclasses import replace

import numpy as np

from objslam.config import Settings
from objslam.core.types import Log
from objslam.frontend.localization.localization_jumps import Jumps, find_jumps
from objslam.mapping.checks.agreement import agreements, bounded_part
from objslam.mapping.checks.finding import JUMPS, Finding

_LOSS = 0.02
"""The jumps are right if the score (`Agreement.score`) falls by more than this value when they are taken out. Some
localisations drift for a while and then correct the drift by a jump. Such a localisation is right before the drift and after
the jump. With a larger value, more jumps are taken out."""


def wrong_jumps(log: Log, settings: Settings) -> Jumps | None:
    """Return the jumps of a localisation that a run takes out. None if there are none, or if the boxes agree better with
    them."""
    jumps = find_jumps(log, settings)
    if jumps is None or not any(c.detections is not None and len(c.detections.frame_stamps) for c in log.cameras):
        return jumps
    part = bounded_part(log, settings)
    given, without = agreements(part, (part.log, taken_out(jumps, part.log)), settings)
    refuted = given is not None and without is not None and without.score < given.score - _LOSS
    return None if refuted else jumps


def taken_out(jumps: Jumps | None, log: Log) -> Log:
    """Return a log without the jumps of its localisation."""
    if jumps is None or log.localization is None:
        return log
    return replace(log, localization=jumps.taken_out(log.localization))


def corrected_jumps(jumps: Jumps) -> Finding:
    """Return the finding about jumps that a run takes out."""
    way, angle = np.linalg.norm(jumps.moves[0]), np.degrees(np.linalg.norm(jumps.turns[0]))
    return Finding(
        JUMPS,
        f"the localisation jumps {len(jumps)} time{'' if len(jumps) == 1 else 's'} (first by {way:.2f} m and "
        f"{angle:.0f} deg at stamp {jumps.stamps[0]:.3f}): the run joins the path at each jump. It does not know "
        f"which side was right, so the whole map may be off by {jumps.sigma:.2f} m, and its sigmas contain this",
        spoils=False,
    )
