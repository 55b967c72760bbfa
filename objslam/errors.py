"""Errors that a user can correct. Each error names the problem and, if they are known, the place and the remedy."""

import errno


def printable(text: str) -> str:
    """Return a text with each character that is not printable as its escape, such as \\x1b. Line breaks (\\n) stay.

    A name in a log may hold terminal commands, or marks that reverse the order of letters.
    """
    if text.isprintable():
        return text
    return "".join(c if c.isprintable() or c == "\n" else c.encode("unicode_escape").decode() for c in text)


def one_line(text: object) -> str:
    """Return a text, or the text of an exception, as one printable line. An exception without text gives its type name."""
    said = str(text)
    if not said.isprintable():
        said = printable(" ".join(part for line in said.splitlines() if (part := line.strip())))
    return type(text).__name__ if not said and isinstance(text, BaseException) else said


def is_out_of_memory(error: BaseException) -> bool:
    """Return whether an error says that there is no memory left: for data, for a thread, or for a library."""
    if isinstance(error, MemoryError) or (isinstance(error, OSError) and error.errno == errno.ENOMEM):
        return True
    texts = {RuntimeError: "can't start new thread", ImportError: "failed to map segment"}
    return any(isinstance(error, kind) and text in str(error) for kind, text in texts.items())


class ObjslamError(Exception):
    """A failure that a user can correct. `where` is the place, such as a file:line, a topic or a stamp. `hint` is the
    remedy. The message, `where` and `hint` are reduced to one line each, so the text of the error is also one line.
    `exit_code` is the exit code of a command that fails with this error."""

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
    """Return at most 300 characters of the first line of an error, or the type name of an error without a text."""
    text = str(error).strip().splitlines()
    return text[0][:300] if text else type(error).__name__


class LogError(ObjslamError):
    """A log, or a necessary part of it, cannot be read."""


class SolveError(ObjslamError):
    """An estimation has no solution, because there is nothing to solve or because every solver fails."""


class DetectorError(ObjslamError):
    """A detector model cannot be loaded, interpreted or run."""


class OutputError(ObjslamError):
    """A result cannot be written or read."""


class ConfigError(ObjslamError):
    """A setting or a command-line option is wrong. This is a usage error."""

    exit_code = 2
