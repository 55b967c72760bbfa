"""Errors that a user can act on: each says what is wrong, where, and what to do."""

from __future__ import annotations


def one_line(text: object) -> str:
    """A text, or what an exception says, on one line that any file can hold; an exception without words by its type."""
    said = str(text)
    if not said.isprintable():
        joined = " ".join(part for line in said.splitlines() if (part := line.strip()))
        said = joined.encode("utf-8", "backslashreplace").decode()
    return type(text).__name__ if not said and isinstance(text, BaseException) else said


class ObjslamError(Exception):
    """The work failed for a reason that a user can act on; `where` is a file:line, topic or stamp, `hint` what to do.

    Whatever the three are made of, they and the error as text are one line each.
    """

    exit_code = 1

    def __init__(self, message: str, *, where: str | None = None, hint: str | None = None) -> None:
        super().__init__(message)
        self.message = one_line(message)
        self.where = where and one_line(where)
        self.hint = hint and one_line(hint)

    def __str__(self) -> str:
        text = f"{self.where}: {self.message}" if self.where else self.message
        return f"{text} ({self.hint})" if self.hint else text


def first_line(error: BaseException) -> str:
    """What an error of some library says first, cut to what fits a line; its kind where it says nothing."""
    text = str(error).strip().splitlines()
    return text[0][:300] if text else type(error).__name__


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
