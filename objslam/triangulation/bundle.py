"""The rays of many objects in one batch, and their division into dense blocks of objects with similar numbers of rays."""

from collections.abc import Iterator
from dataclasses import dataclass
from types import ModuleType

from objslam.core.array_module import Tensor, indices_of

_SIMILAR = (2, 32)
"""The numbers a and b that limit the sizes of the objects in a block. If the smallest object has n rays, the largest one has
at most a n + b rays. Fillers make all objects of a block equally long. Larger numbers make fewer blocks with more fillers.
With 2 and 32, fillers are at most about half of a block. If objects have few rays, fillers are a larger share, but such a
block takes little time."""


@dataclass(frozen=True)
class Bundle:
    """R rays of N objects, sorted by object. All arrays are numpy arrays, or all are torch tensors.

    origin: (R, 3) m, relative to a point near the ray's object, with the axes of map. direction: (R, 3) unit. sigma: (R,)
    rad, the standard deviation of a ray's angle along each perpendicular axis. position_sigma: m, the standard deviation of
    the origins along each axis. index: (R,) the object of each ray. number: (N,) the number of rays of each object. xp: the
    library of the arrays, numpy or torch.
    """

    origin: Tensor
    direction: Tensor
    sigma: Tensor
    position_sigma: float
    index: Tensor
    number: Tensor
    xp: ModuleType

    def select(self, use: Tensor) -> "Bundle":
        """Return the rays in the mask `use` (R,), of the same objects."""
        if bool(use.all()):
            return self
        index = self.index[use]
        number = self.xp.bincount(index, minlength=len(self.number))
        rays = self.origin[use], self.direction[use], self.sigma[use], self.position_sigma
        return Bundle(*rays, index, number, self.xp)

    def blocks(self, objects: Tensor, most: int) -> Iterator[tuple[Tensor, Tensor, Tensor]]:
        """Split objects into blocks of B objects with up to n rays each. objects: the indices of the objects.

        A block holds the objects (B,), the indices (B, n) of their rays, and a mask (B, n) of the real indices. All other
        indices only fill the rows of objects with fewer rays. most: the largest B n of a block of several objects.
        """
        xp = self.xp
        first = xp.cumsum(self.number, 0) - self.number
        objects = objects[xp.argsort(self.number[objects], stable=True)]
        size = self.number[objects]  # The sizes increase, so the objects of a block are consecutive.
        sizes = size.tolist()
        begin = 0
        while begin < len(sizes):
            end, limit = begin + 1, _SIMILAR[0] * sizes[begin] + _SIMILAR[1]
            while end < len(sizes) and sizes[end] <= limit and (end + 1 - begin) * sizes[end] <= most:
                end += 1
            slot = xp.arange(sizes[end - 1], device=self.number.device)
            real = slot < size[begin:end, None]
            yield objects[begin:end], first[objects[begin:end], None] + xp.where(real, slot, 0), real
            begin = end

    def with_rays(self) -> Tensor:
        """Return the indices of the objects that have rays."""
        return indices_of(self.number > 0)
