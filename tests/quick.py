"""Settings for tests in which it does not matter how good a map is: those of files, commands, messages and failures.

The stages that these settings leave out take nine tenths of the time of a small map. Tests of these stages, and tests that
compare a map with the truth, run them.
"""

ROUGH = ("checks.use=false", "bodies.use=false", "noise.localization=false", "noise.odometry=false", "noise.rays=false")
"""No look at the input, no bodies, and the noise that the settings say."""
NOTHING_BESIDE = ("live.calibrate_from=0", "live.search_from=0")
"""No work beside a session while the robot drives: no calibration, and no search through all boxes. The end does both."""
HELD = (*ROUGH, "calibration.use=false", *NOTHING_BESIDE)
"""No shared errors either, and no work beside a session."""
NOTHING_DRAWN = ("output.recording=false", "output.picture=false")


def options(*settings: str) -> tuple[str, ...]:
    """Return settings as arguments of a command."""
    return tuple(word for setting in settings for word in ("--set", setting))


QUICK = options(*HELD, *NOTHING_DRAWN)
