"""What was dropped and why, and what a user should know: counted while the work goes on, written into summary.json."""

from __future__ import annotations

from dataclasses import dataclass, field

from objslam.errors import one_line

_EXAMPLES = 3


@dataclass
class Ledger:
    """Counts of what was dropped (by reason, with the first few places) and warnings in plain words, one line each."""

    dropped: dict[str, int] = field(default_factory=dict)
    examples: dict[str, list[str]] = field(default_factory=dict)
    warnings: list[str] = field(default_factory=list)

    def drop(self, reason: str, count: int = 1, where: str | None = None) -> None:
        """Add `count` to the number of things dropped for `reason`.

        where: the place (file:line or stamp); only the first few places of each reason are kept.
        """
        if count <= 0:
            return
        reason = one_line(reason)
        self.dropped[reason] = self.dropped.get(reason, 0) + int(count)
        places = self.examples.setdefault(reason, [])
        if where is not None and len(places) < _EXAMPLES and (place := one_line(where)) not in places:
            places.append(place)

    def warn(self, message: str) -> None:
        """Keep a warning once."""
        message = one_line(message)
        if message not in self.warnings:
            self.warnings.append(message)

    def add(self, other: Ledger) -> None:
        """Take over what another ledger counted."""
        for reason, count in other.dropped.items():
            places = other.examples.get(reason, [])
            self.drop(reason, count, places[0] if places else None)
        for message in other.warnings:
            self.warn(message)

    def lines(self) -> list[str]:
        """Every drop and warning as one line of text each, drops first."""
        lines = []
        for reason, count in self.dropped.items():
            places = self.examples.get(reason)
            lines.append(f"dropped {count}: {reason}" + (f" (first: {', '.join(places)})" if places else ""))
        return lines + self.warnings
