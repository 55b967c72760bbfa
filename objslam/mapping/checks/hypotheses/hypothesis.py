"""A hypothesis: a possible fault of the input, as a change that would correct the log."""

from collections.abc import Callable
from dataclasses import dataclass, replace

from objslam.core.types import CameraLog, Log


@dataclass(frozen=True)
class Hypothesis:
    """A possible fault of the input.

    name: a short fixed name. what: a description of the corrected log. cause: the probable mistake. put_right: returns the
    corrected log. of_mount: whether the hypothesis is about the rotation of a camera on the robot. usual: whether people
    often make this mistake. If two hypotheses explain a log equally, the usual one is named. clock: the time (s) by which
    `put_right` makes the stamps of the frames later, 0 if the hypothesis is not about a clock.
    """

    name: str
    what: str
    cause: str
    put_right: Callable[[Log], Log]
    of_mount: bool = False
    usual: bool = True
    clock: float = 0.0


def with_cameras(log: Log, change: Callable[[CameraLog], CameraLog]) -> Log:
    """Return the log with each of its cameras changed."""
    return replace(log, cameras=tuple(change(one) for one in log.cameras))
