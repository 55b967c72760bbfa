"""A finding: the result of a check that found a fault."""

from dataclasses import dataclass
from typing import Any, Literal

JUMPS = "localisation jumps"
"""The name of the finding that a localisation jumps. A localisation that jumps often is wrong for seconds each time."""
NEIGHBOURS = "equal things nearer than the poses err"
"""The name of the finding that the errors of poses are as large as the distances between equal things. It does not mean that
the input is wrong."""
NOISIER = "noise"
"""The name of the finding that a log is far noisier than the settings say. It does not mean that the input is wrong."""


@dataclass(frozen=True)
class Finding:
    """One thing that is wrong with the input.

    name: a short fixed name, for programs. message: one line that names the cause, for people. spoils: whether the fault
    makes the positions of a map unreliable, because the run does not correct it. basis: what shows the fault. "log": the
    input itself. "boxes": the boxes do not agree at the given poses. "halves": the boxes of the two halves of the log do not
    agree with each other. "frames": the boxes of single frames do not agree. "lens": the boxes agree better with another
    lens. "ranges": the ranges do not agree with the distances that the odometry measured. A joint solve may refute a
    finding, except one with the basis "log".
    """

    name: str
    message: str
    spoils: bool = True
    basis: Literal["log", "boxes", "halves", "frames", "lens", "ranges"] = "log"

    def to_dict(self) -> dict[str, Any]:
        """Return the entry of summary.json."""
        return {"name": self.name, "message": self.message, "spoils_positions": self.spoils}
