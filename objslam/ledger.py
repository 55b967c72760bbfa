"""What was dropped and why, and what a user should know: counted while the work goes on, written into summary.json."""

from __future__ import annotations

from dataclasses import dataclass, field

_EXAMPLES = 3


@dataclass
class Ledger:
    """Counts of what was dropped (by reason, with the first few places) and warnings in plain words."""

    dropped: dict[str, int] = field(default_factory=dict)
    examples: dict[str, list[str]] = field(default_factory=dict)
    warnings: list[str] = field(default_factory=list)

    def drop(self, reason: str, count: int = 1, where: str | None = None) -> None:
        """Count `count` things dropped for `reason`; `where` (file:line, stamp) is kept for the first few."""
        if count <= 0:
            return
        self.dropped[reason] = self.dropped.get(reason, 0) + int(count)
        places = self.examples.setdefault(reason, [])
        if where is not None and where not in places and len(places) < _EXAMPLES:
            places.append(where)

    def warn(self, message: str) -> None:
        """Keep a warning once."""
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
