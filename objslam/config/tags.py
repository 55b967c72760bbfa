"""The settings of square fiducials (AprilTag, ArUco)."""

from typing import Self

from pydantic import Field

from objslam.config.section import Positive, Section


class Tags(Section):
    """Configure fiducials whose four corners are known. Each becomes a landmark with a position and a rotation."""

    use: bool = True
    """Use the corners. false: a fiducial is one point, where its diagonals meet."""
    size: Positive | None = None
    """Side in m of every fiducial, from corner to corner as the detector reports them. This length gives the map its scale.
    null: the size of each fiducial is estimated, in the scale that the poses have."""
    sizes: dict[int | str, Positive | None] = Field(default_factory=dict)
    """Sides in m of single fiducials, instead of `size`. A key is the number in the label (12 for tag_12) or a whole label.
    null: the size of this fiducial is estimated."""
    corner_sigma: Positive = 1.0
    """Standard deviation of a corner per axis in px. It covers the error of the detector, which is smaller, and the error
    that a lens calibration leaves. An estimated factor on the noise of rays also multiplies this noise."""

    def scaled(self, ratio: float) -> Self:
        """Return the settings with all given sizes multiplied by a ratio."""
        if ratio == 1:
            return self
        size = None if self.size is None else self.size * ratio
        sizes = {key: None if side is None else side * ratio for key, side in self.sizes.items()}
        return self.model_copy(update={"size": size, "sizes": sizes})

    def size_of(self, label: str) -> float | None:
        """Return the side (m) of the fiducial with a label, None if it is not known."""
        number = label.rpartition("_")[2]
        for key in (label, number, int(number) if number.isascii() and number.isdigit() and len(number) < 10 else number):
            if key in self.sizes:
                return self.sizes[key]
        return self.size
