"""Errors that a user can act on: each says what is wrong, where, and what to do."""

from __future__ import annotations


class ObjslamError(Exception):
    """The work failed for a reason that a user can act on; `where` is a file:line, topic or stamp, `hint` what to do."""

    exit_code = 1

    def __init__(self, message: str, *, where: str | None = None, hint: str | None = None) -> None:
        super().__init__(message)
        self.message = message
        self.where = where
        self.hint = hint

    def __str__(self) -> str:
        text = f"{self.where}: {self.message}" if self.where else self.message
        return f"{text} ({self.hint})" if self.hint else text


class LogError(ObjslamError):
    """A log, or a part of it that the work cannot do without, cannot be read."""


class SolveError(ObjslamError):
    """The estimation has no answer to give: nothing to solve, or no solver found one."""


class DetectorError(ObjslamError):
    """A detector model cannot be loaded, understood or run."""


class OutputError(ObjslamError):
    """A result cannot be written or read back."""


class ConfigError(ObjslamError):
    """A setting or an option is wrong: wrong use, not failed work."""

    exit_code = 2
