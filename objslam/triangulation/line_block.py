"""Lines of several objects in dense arrays, and small symmetric systems of all objects at once.

The first axis of an array holds the coordinates of a vector, and the last axis the objects. So each operation is one pass
over contiguous numbers, and a sum over the lines of an object needs no indices.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from types import ModuleType

from objslam.core.array_module import Tensor, as_type, contiguous, rows
from objslam.triangulation.bundle import Bundle

_FULL = (0, 3, 4, 3, 1, 5, 4, 5, 2)  # For each of the nine entries of a symmetric matrix, the index of its value in `outer`.
UPPER, _LOWER = (0, 4, 8, 1, 2, 5), (0, 4, 8, 3, 6, 7)  # For each value in `outer`, the indices of its two entries of nine.


@dataclass(frozen=True)
class LineBlock:
    """Lines of B objects with up to n lines each, in coordinates of their object.

    foot: (3, n, B) the point of each line nearest to the coordinate origin. direction: (3, n, B) unit. weight: (n, B) 1 for
    a line, 0 for a filler. xp: the library of the arrays, numpy or torch.
    """

    foot: Tensor
    direction: Tensor
    weight: Tensor
    xp: ModuleType

    def offset(self, points: Tensor) -> Tensor:
        """Return the perpendicular offset (3, n, B) from each line to the point (3, B) of its object."""
        return perpendicular(points[:, None], self.direction) - self.foot

    def spread(self, weight: Tensor) -> Tensor:
        """Return the six entries (6, B) of the sum of weight (n, B) times I - d d^T over the lines of each object.

        d: the direction of a line. The order of the entries is that of `outer`.
        """
        result = -outer(self.direction * weight, self.direction, self.xp)
        result[:3] += weight.sum(axis=0)
        return result

    def select(self, objects: Tensor) -> LineBlock:
        """Return the lines of the objects in a mask (B,)."""
        return LineBlock(self.foot[:, :, objects], self.direction[:, :, objects], self.weight[:, objects], self.xp)

    def scaled(self, scale: Tensor) -> LineBlock:
        """Return the lines with feet multiplied by the scale (B,) of their object."""
        return replace(self, foot=self.foot * scale)


def gather(bundle: Bundle, rays: Tensor, real: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return origins (3, n, B), directions (3, n, B) and weights (n, B) of one block of rays.

    rays, real: (B, n) as `Bundle.blocks` yields them. The longer one of the axes n and B is contiguous in memory, because a
    pass along a short contiguous axis is slow.
    """
    wide = rays.shape[0] >= rays.shape[1]
    weight = as_type(real, bundle.origin)
    rays, weight = (rays.T, weight.T) if wide else (rays, weight)
    parts = [contiguous(bundle.xp.moveaxis(rows(values, rays), 2, 0)) for values in (bundle.origin, bundle.direction)]
    parts.append(contiguous(weight))
    origin, direction, weight = parts if wide else [part.mT for part in parts]
    return origin, direction, weight


def through(origin: Tensor, direction: Tensor, weight: Tensor, xp: ModuleType) -> LineBlock:
    """Return the lines through points (3, n, B), in coordinates of their object, along unit directions (3, n, B)."""
    # The first projection leaves a rounding error along the line, which grows with the origin. The second removes it.
    return LineBlock(perpendicular(perpendicular(origin, direction), direction), direction, weight, xp)


def perpendicular(vectors: Tensor, direction: Tensor) -> Tensor:
    """Return the part (3, n, B) of vectors (3, n, B) that is perpendicular to the unit directions (3, n, B)."""
    return vectors - direction * dot(vectors, direction)


def dot(a: Tensor, b: Tensor) -> Tensor:
    """Return the dot products (...) of vectors (3, ...)."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def norm(vectors: Tensor) -> Tensor:
    """Return the lengths (...) of vectors (3, ...)."""
    return dot(vectors, vectors) ** 0.5


def outer(a: Tensor, b: Tensor, xp: ModuleType) -> Tensor:
    """Return the sums (6, B) of (a b^T + b a^T) / 2 over the lines of each object: xx, yy, zz, xy, xz, yz.

    a, b: (3, n, B). `b` may be `a` times a weight, or any other vector.
    """
    nine = products(a, b, xp)
    return 0.5 * (nine[list(UPPER)] + nine[list(_LOWER)])


def products(a: Tensor, b: Tensor, xp: ModuleType) -> Tensor:
    """Return the sums (9, B) of a b^T over the lines of each object, row by row.

    a, b: (3, n, B). One call takes a third of the time of six products and their sums, if objects have some tens of lines.
    """
    return xp.einsum("inb,jnb->ijb", a, b).reshape(9, -1)


def full(six: Tensor) -> Tensor:
    """Return symmetric matrices (B, 3, 3) from their six entries (6, B)."""
    return six[list(_FULL)].T.reshape(-1, 3, 3)


def solve_symmetric(a: Tensor, b: Tensor, xp: ModuleType) -> tuple[Tensor, Tensor]:
    """Return x (3, B) with A x = b by Cramer's rule, and the regularity (B,) of A, from 0 to 1.

    The regularity is the determinant divided by the cube of the mean eigenvalue. If A is singular, x has no meaning. a: (6,
    B) the entries of A, which is positive semidefinite, in the order of `outer`. b: (3, B).
    """
    xx, yy, zz, xy, xz, yz = a
    c0, c1, c2 = yy * zz - yz * yz, xz * yz - xy * zz, xy * yz - xz * yy
    determinant = xx * c0 + xy * c1 + xz * c2
    c3, c4, c5 = xx * zz - xz * xz, xy * xz - xx * yz, xx * yy - xy * xy
    mean = (xx + yy + zz) / 3
    regular = determinant / (mean * mean * mean).clip(min=1e-30)
    x = xp.stack([dot((c0, c1, c2), b), dot((c1, c3, c4), b), dot((c2, c4, c5), b)])
    return x / xp.where(determinant == 0, 1.0, determinant), regular


def apply(matrices: Tensor, vectors: Tensor) -> Tensor:
    """Return the products (3, B) of matrices (B, 3, 3) and vectors (3, B)."""
    return (matrices @ vectors.T[:, :, None])[:, :, 0].T
