"""The rays of many objects in one batch, and their division into dense blocks of objects with similar numbers of rays."""

from collections.abc import Iterator
from dataclasses import dataclass
from types import ModuleType

from objslam.core.array_module import Tensor, indices_of

_SIMILAR = (2, 32)
"""The numbers a and b. If the smallest object of a block has n rays, the largest one has at most a n + b rays. Fillers make
all objects of a block equally long. Larger values make fewer blocks with more fillers. With these values, at most about half
of a block is fillers. The share is larger if objects have few rays, but such a block costs little."""


@dataclass(frozen=True)
class Bundle:
    """Rays of many objects, sorted by object. All arrays are numpy arrays, or all are torch tensors.

    origin: (R, 3) m, in coordinates of the ray's object. direction: (R, 3) unit. sigma: (R,) rad, noise of a ray's angle
    along each perpendicular axis. position_sigma: m, noise of the origins along each axis. index: (R,) object of each ray.
    number: (N,) number of rays of each object. xp: the library of the arrays, numpy or torch.
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
        """Split objects, given by their indices, into blocks of B objects with up to n rays each.

        A block holds the objects (B,), the indices of their rays (B, n), and which of these indices are real. The other
        indices only fill the rows of objects with fewer rays. most: the largest B n of a block of several objects.
        """
        xp = self.xp
        first = xp.cumsum(self.number, 0) - self.number
        objects = objects[xp.argsort(self.number[objects], stable=True)]
        size = self.number[objects]  # The sizes increase, so the fitting objects come first.
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
