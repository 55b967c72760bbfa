"""The rows that hold the corners of fiducials together as squares, without variables of their own.

The square nearest to four corners is computed from the corners. The residual is the corners minus the corners of this
square. So a step that only moves or turns the square does not change the residual.
"""

from dataclasses import dataclass, replace
from typing import Self

import numpy as np

from objslam.core.arrays import Floats, Ints
from objslam.graph.factors.tags import TIE
from objslam.graph.tags.corner_rays import TagCorners
from objslam.graph.tags.shapes import squares_of, turned_by_squares


@dataclass(frozen=True)
class SquareRows:
    """T squares among the landmarks of a graph, twelve rows each.

    tag: (T,) the fiducial of each. corner: (T, 4) the row of each corner among the landmarks. shape: (T, 4, 3) the corners
    at side 1. side: (T,) m, NaN for a free side.
    """

    tag: Ints
    corner: Ints
    shape: Floats
    side: Floats

    @classmethod
    def of(cls, tags: TagCorners | None, landmarks: Ints) -> Self:
        """Return the squares whose four corners are all among the landmarks (m,). The landmarks are in increasing order."""
        if tags is None:
            return cls(np.zeros(0, dtype=np.int64), np.zeros((0, 4), dtype=np.int64), np.zeros((0, 4, 3)), np.zeros(0))
        tied = tags.tied(landmarks)
        return cls(tied, np.searchsorted(landmarks, tags.landmarks[tied]), tags.shape[tied], tags.side[tied])

    def sized(self, tags: TagCorners | None) -> Self:
        """Return the same squares with the sides of `tags`."""
        return self if tags is None else replace(self, side=tags.side[self.tag])

    @property
    def rows_each(self) -> int:
        """The rows of a square: three for each corner."""
        return 12

    @property
    def columns(self) -> Ints:
        """(T, 12) the columns of the corners of each square."""
        return (3 * self.corner[:, :, None] + np.arange(3)).reshape(-1, 12)

    def rows(self, map_T_camera: Floats, landmarks: Floats) -> tuple[Floats, Floats, float]:
        """Return the whitened residuals (T, 12), the derivatives (T, 12, 12) of the residuals by the corners, and the cost.

        landmarks: (M, 3) m. map_T_camera: not used.
        """
        corners = landmarks[self.corner]
        rotation, centre, found = squares_of(corners, self.shape)
        free = np.isnan(self.side)
        side = np.where(free, found, self.side)
        local = self.shape * side[:, None, None]
        square = np.einsum("tij,tcj->tci", rotation, local) + centre[:, None]
        by_square = turned_by_squares(local, rotation)
        by_square[:, :, 6] *= free[:, None]
        off = np.eye(12) - by_square @ np.linalg.pinv(by_square)
        sigma = self._sigma(side)
        bent = (corners - square).reshape(-1, 12) / sigma[:, None]
        return bent, off / sigma[:, None, None], float((bent**2).sum() / 2)

    def by_sides(self, landmarks: Floats, sides: Floats) -> Floats:
        """Return the whitened residuals (T, 12) at sides (T,), m, with the noise of the present sides. A free side has 0."""
        rotation, centre, _ = squares_of(landmarks[self.corner], self.shape)
        square = np.einsum("tij,tcj->tci", rotation, self.shape * sides[:, None, None]) + centre[:, None]
        off = (landmarks[self.corner] - square).reshape(-1, 12) / self._sigma(self.side)[:, None]
        return np.where(np.isnan(self.side)[:, None], 0.0, off)

    def _sigma(self, side: Floats) -> Floats:
        """Return the noise (T,), m, of the corners of squares with sides (T,), m."""
        return np.asarray(TIE * side * np.linalg.norm(self.shape[:, 0], axis=1))
