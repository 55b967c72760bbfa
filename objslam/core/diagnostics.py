"""The ledger of a run: counts of dropped data and warnings to the user. summary.json contains it."""

from __future__ import annotations

from dataclasses import dataclass, field

from objslam.errors import one_line

_DROPPED = "dropped "  # The first word of a line about dropped data.
_EXAMPLES = 3  # The most places that are kept for each reason. A larger number makes the lines of text longer.
_MOST_WARNINGS = 1000  # The most warnings. A larger number costs memory if made-up messages cause warnings.


def is_drop(line: str) -> bool:
    """Return whether a line of a ledger is about dropped data."""
    return line.startswith(_DROPPED)


@dataclass
class Ledger:
    """The dropped data by reason, and warnings of one line each. A reason has the count, the first places, and the number of
    data that were checked, if known. unused: the paths of the robot in the log that a run does not use."""

    dropped: dict[str, int] = field(default_factory=dict)
    totals: dict[str, int] = field(default_factory=dict)
    examples: dict[str, list[str]] = field(default_factory=dict)
    warnings: list[str] = field(default_factory=list)
    unused: list[str] = field(default_factory=list)

    def drop(self, reason: str, count: int = 1, where: str | None = None, of: int | None = None) -> None:
        """Count dropped data under a reason.

        of: the number of data that were checked, None if unknown. where: file:line or stamp, kept for the first drops.
        """
        reason = one_line(reason)
        if of is not None:
            self.totals[reason] = self.totals.get(reason, 0) + int(of)
        if count <= 0:
            return
        self.dropped[reason] = self.dropped.get(reason, 0) + int(count)
        places = self.examples.setdefault(reason, [])
        if where is not None and len(places) < _EXAMPLES and (place := one_line(where)) not in places:
            places.append(place)

    def warn(self, message: str) -> None:
        """Add a warning, unless the ledger has it already. Warnings beyond the first `_MOST_WARNINGS` are counted."""
        message = one_line(message)
        if message in self.warnings:
            return
        if len(self.warnings) < _MOST_WARNINGS:
            self.warnings.append(message)
        else:
            self.drop(f"warnings beyond the first {_MOST_WARNINGS}", where=message)

    def do_without(self, name: str, reason: object) -> None:
        """Count a path of the robot as unused, and warn of the reason."""
        self.unused.append(one_line(name))
        self.warn(f"{reason}: left out")

    def add(self, other: Ledger) -> None:
        """Add the counts and warnings of another ledger, with the first example of each reason."""
        for reason, count in other.dropped.items():
            self.drop(reason, count, next(iter(other.examples.get(reason, [])), None), other.totals.get(reason))
        for message in other.warnings:
            self.warn(message)
        self.unused.extend(other.unused)

    def copy(self) -> Ledger:
        """Return a ledger with the same entries."""
        examples = {reason: list(places) for reason, places in self.examples.items()}
        return Ledger(dict(self.dropped), dict(self.totals), examples, list(self.warnings), list(self.unused))

    def restore(self, earlier: Ledger) -> None:
        """Replace all entries by the entries of an earlier copy."""
        self.dropped, self.totals, self.examples, self.warnings, self.unused = vars(earlier.copy()).values()

    def lines(self) -> list[str]:
        """Return each drop and then each warning as one line of text, as the terminal and summary.json show them."""
        lines = []
        for reason, count in self.dropped.items():
            places, total = self.examples.get(reason), self.totals.get(reason)
            share = f" of {total} ({100 * count / total:.0f} %)" if total else ""
            lines.append(f"{_DROPPED}{count}{share}: {reason}" + (f" (first: {'; '.join(places)})" if places else ""))
        return lines + self.warnings
