"""Errors that a user can correct. Each error names the problem, the place and the remedy."""


def one_line(text: object) -> str:
    """Return a text or an exception as one line of valid Unicode. An exception without a text becomes its type name."""
    said = str(text)
    if not said.isprintable():
        joined = " ".join(part for line in said.splitlines() if (part := line.strip()))
        said = joined.encode("utf-8", "backslashreplace").decode()
    return type(text).__name__ if not said and isinstance(text, BaseException) else said


class ObjslamError(Exception):
    """Report a failure that a user can correct. `where` is a file:line, topic or timestamp, and `hint` is the remedy.
    Message, place, hint and the text of the error become one line each."""

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
    """Report a log, or a necessary part of a log, that cannot be read."""


class SolveError(ObjslamError):
    """Report an estimation without a solution: there is nothing to solve, or every solver fails."""


class DetectorError(ObjslamError):
    """Report a detector model that cannot be loaded, interpreted or run."""


class OutputError(ObjslamError):
    """Report a result that cannot be written or read."""


class ConfigError(ObjslamError):
    """Report a wrong setting or option, which is a usage error."""

    exit_code = 2
