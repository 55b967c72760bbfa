"""Choose the poses and the mode of a run. The settings say them, or leave the choice to the log."""

from dataclasses import replace

from objslam.config import Settings
from objslam.core.diagnostics import Ledger
from objslam.core.result import RunResult
from objslam.core.types import Log
from objslam.errors import LogError
from objslam.frontend.localization.continued_localization import (
    continued_by_odometry,
    share_on_continuation,
    without_short_localization,
)
from objslam.mapping.checks.finding import JUMPS

_BEYOND = 0.1
"""The least share of boxes for which the odometry continues the localisation, so that the mode `auto` solves the poses. A
larger share saves the time of this solve in more logs, and leaves out more boxes."""
_LOCALIZATION = "the localisation"
"""The name of a localisation that is left out, in the warning and in the assessment."""


def with_chosen_poses(log: Log, settings: Settings, ledger: Ledger) -> Log:
    """Return the log with its `chosen_poses`. The ledger gets a warning if a short localisation is left out."""
    chosen = chosen_poses(log, settings)
    if settings.poses.use == "auto" and chosen.localization is not log.localization:
        without_localization(ledger, "covers too few boxes")
    return chosen


def without_localization(ledger: Ledger, reason: str) -> None:
    """Add the warning that a run does without the localisation."""
    ledger.do_without(_LOCALIZATION, f"{_LOCALIZATION} {reason} (--set poses.use=localization uses it alone)")


def lost_localization(result: RunResult) -> bool:
    """Return whether jumps of the localisation spoil the map, as if the localisation was lost for a while."""
    return any(one["name"] == JUMPS and one["spoils_positions"] for one in result.summary["wrong_input"])


def chosen_poses(log: Log, settings: Settings) -> Log:
    """Return the log with the poses that the settings choose.

    With `poses.use: auto`, a localisation that covers few boxes is left out, unless the mode is `fixed`. LogError if the log
    lacks the chosen poses.
    """
    use = settings.poses.use
    if use == "auto":
        return log if settings.mode == "fixed" else without_short_localization(log, settings)
    if (log.odometry if use == "odometry" else log.localization) is None:
        raise LogError(f"the log has no {use}", where=log.name, hint="set poses.use to auto")
    return replace(log, localization=None) if use == "odometry" else replace(log, odometry=None)


def with_mode_of(log: Log, settings: Settings) -> Settings:
    """Return the settings with the mode that `auto` means for a log. log: with its chosen poses."""
    if settings.mode != "auto":
        return settings
    more = share_on_continuation(log, continued_by_odometry(log, settings), settings)
    joint = log.localization is None or more >= _BEYOND
    return settings.model_copy(update={"mode": "joint" if joint else "fixed"})
