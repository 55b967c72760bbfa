"""Lines of many objects in flat arrays, with the index of its object for each line.

`line_block` is faster for repeated passes.
"""

from __future__ import annotations

from dataclasses import dataclass
from types import ModuleType
from typing import Self

from objslam.core.array_module import Tensor, group_sum


@dataclass(frozen=True)
class Lines:
    """R lines to N objects. Each object has its own coordinates.

    foot: (R, 3) the point of each line nearest to the coordinate origin of its object. direction: (R, 3) unit. index: (R,)
    the object of each line. count: the number N of objects. xp: the library of the arrays, numpy or torch.
    """

    foot: Tensor
    direction: Tensor
    index: Tensor
    count: int
    xp: ModuleType

    @classmethod
    def through(cls, origin: Tensor, direction: Tensor, index: Tensor, count: int, xp: ModuleType) -> Self:
        """Make lines through the points `origin` (R, 3), in coordinates of their object, along unit directions (R, 3)."""
        # The first projection leaves a rounding error along the line, which grows with the origin. The second removes it.
        return cls(_perpendicular(_perpendicular(origin, direction), direction), direction, index, count, xp)

    def sum(self, values: Tensor) -> Tensor:
        """Return the sum (N, ...) of the values (R, ...) over the lines of each object."""
        return group_sum(values, self.index, self.count)

    def offset(self, points: Tensor) -> Tensor:
        """Return the perpendicular offset (R, 3) from each line to the point (N, 3) of its object."""
        return _perpendicular(points[self.index], self.direction) - self.foot

    def spread(self, weight: Tensor) -> Tensor:
        """Return the sum (N, 3, 3) of weight (R,) times I - n n^T over the lines of each object. n: a line's direction."""
        eye = self.xp.eye(3, dtype=weight.dtype, device=weight.device)
        return self.sum(weight)[:, None, None] * eye - self.outer(self.direction * weight[:, None], self.direction)

    def outer(self, a: Tensor, b: Tensor) -> Tensor:
        """Return the sum (N, 3, 3) of (a b^T + b a^T) / 2 over the lines of each object, with vectors a, b (R, 3)."""
        (a0, a1, a2), (b0, b1, b2) = a.T, b.T
        off = [0.5 * (a0 * b1 + a1 * b0), 0.5 * (a0 * b2 + a2 * b0), 0.5 * (a1 * b2 + a2 * b1)]
        six = self.sum(self.xp.stack([a0 * b0, a1 * b1, a2 * b2, *off], axis=1))
        return six[:, [0, 3, 4, 3, 1, 5, 4, 5, 2]].reshape(-1, 3, 3)


def _perpendicular(vectors: Tensor, direction: Tensor) -> Tensor:
    """Return the part (R, 3) of each vector (R, 3) that is perpendicular to its unit direction (R, 3)."""
    return vectors - direction * (vectors * direction).sum(axis=1)[:, None]
