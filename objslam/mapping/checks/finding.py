"""What a check found."""

from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class Finding:
    """One thing that is wrong with the input.

    name: short and fixed, for programs. message: one line that names the cause, for people. spoils: whether the positions
    of a map cannot be relied on, because the error is not corrected. by_boxes: whether only the agreement of the
    boxes says so. by_halves: whether it compares the halves of the log.
    """

    name: str
    message: str
    spoils: bool = True
    by_boxes: bool = False
    by_halves: bool = False

    def to_dict(self) -> dict[str, Any]:
        """Return what summary.json holds."""
        return {"name": self.name, "message": self.message, "spoils_positions": self.spoils}
