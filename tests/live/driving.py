"""Drive a session through a log, message by message, and wait for it after each frame."""

from collections.abc import Callable, Iterable

from waiting import LIMIT

from objslam.core.types import Log
from objslam.live.adapters.replay import events
from objslam.live.session.session import Session


def feed(
    session: Session,
    log: Log,
    begin: int = 0,
    end: int | None = None,
    pushes: Iterable | None = None,
    until: Callable[[], bool] = lambda: False,
) -> Session:
    """Push the messages from `begin` to `end` of a log, or other `pushes`. Stop early when `until()` becomes true."""
    if begin == 0:
        session.push_camera(log.cameras[0].camera)
    for _, frame, one in pushes if pushes is not None else list(events(log))[begin:end]:
        one(session)
        if frame:
            assert session.wait(LIMIT), session.failure
            if until():
                return session
    assert session.wait(LIMIT), session.failure  # for the poses after the last frame
    return session
