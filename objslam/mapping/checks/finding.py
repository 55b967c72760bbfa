"""What a check found."""

from dataclasses import dataclass
from typing import Any, Literal


@dataclass(frozen=True)
class Finding:
    """One thing that is wrong with the input.

    name: short and fixed, for programs. message: one line that names the cause, for people. spoils: whether the positions
    of a map cannot be relied on, because the error is not corrected. basis: what says so. "log" is the input itself. The
    others are how well boxes agree at the given poses: all "boxes", those of the "halves" of the log, or those of single
    "frames". A joint solve may refute these.
    """

    name: str
    message: str
    spoils: bool = True
    basis: Literal["log", "boxes", "halves", "frames"] = "log"

    def to_dict(self) -> dict[str, Any]:
        """Return what summary.json holds."""
        return {"name": self.name, "message": self.message, "spoils_positions": self.spoils}
