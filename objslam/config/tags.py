"""The settings of square fiducials (AprilTag, ArUco)."""

from typing import Self

from pydantic import Field

from objslam.config.section import Positive, Section


class Tags(Section):
    """Configure square fiducials, whose four corners are detected. Each becomes a landmark with a position and a
    rotation."""

    use: bool = True
    """Use the four corners. false: use only one point of a fiducial, where its diagonals meet."""
    size: Positive | None = None
    """Side length in m of all fiducials, from corner to corner as the detector reports the corners. This length gives the
    map its scale. null: the size of each fiducial is estimated, in the scale of the poses."""
    sizes: dict[int | str, Positive | None] = Field(default_factory=dict)
    """Side lengths in m of single fiducials, which replace `size`. A key is the number in the label (12 for tag_12) or the
    whole label. null: the size of this fiducial is estimated."""
    corner_sigma: Positive = 1.0
    """Standard deviation of a corner per axis in px. It covers the error of the detector, which is smaller, and the error
    that remains after lens calibration. If a run estimates a factor on the noise of rays, this factor also multiplies this
    noise."""

    def scaled(self, ratio: float) -> Self:
        """Return the settings with all given sizes multiplied by a ratio."""
        if ratio == 1:
            return self
        size = None if self.size is None else self.size * ratio
        sizes = {key: None if side is None else side * ratio for key, side in self.sizes.items()}
        return self.model_copy(update={"size": size, "sizes": sizes})

    def size_of(self, label: str) -> float | None:
        """Return the side length (m) of the fiducial with a label. Return None if the length is not known."""
        number = label.rpartition("_")[2]
        for key in (label, number, int(number) if number.isascii() and number.isdigit() and len(number) < 10 else number):
            if key in self.sizes:
                return self.sizes[key]
        return self.size
