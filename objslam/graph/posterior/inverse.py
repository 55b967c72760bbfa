"""Blocks of the inverse of the normal equations of a graph, by the keys of its variables."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Self

import numpy as np
from scipy import sparse

from objslam.core.arrays import Floats, Ints
from objslam.errors import SolveError
from objslam.graph.least_squares.normal_equations import NormalEquations, elimination_order

LEAST_PIVOT = 1e-11
"""The smallest pivot of a system with a single solution. The pivots are those of the information matrix, scaled to 1 on the
diagonal. Rounding leaves a pivot of about 1e-15 if a system has no single solution. A larger value refuses more systems that
have a solution, but are badly conditioned."""
_COLUMNS = 48
"""The number of columns of the inverse that are computed at once. A larger number takes more memory."""
_DENSE, _EACH = 2000, 8
"""The largest numbers of columns of a dense block of the inverse. The first limits all columns, the second limits them for
each requested column. Beyond these limits, single columns take less time. With larger numbers, dense blocks are used more
often."""


@dataclass(frozen=True)
class Inverse:
    """The inverse of the normal equations of a graph, with a part for each variable.

    normal: the normal equations, with columns of length 1. scale: (D,) the lengths of the columns before this scaling.
    begin, end: the columns of each variable, by its key. late_blocks: blocks that were computed before, by their columns.
    """

    normal: NormalEquations
    scale: Floats
    begin: dict[int, int]
    end: dict[int, int]
    late_blocks: dict[bytes, tuple[Ints, Floats]] = field(default_factory=dict)

    @classmethod
    def of(cls, jacobian: sparse.csr_matrix, keys: Sequence[int], variable: Ints, order: Ints | None = None) -> Self | None:
        """Factor the normal equations of a Jacobian (M, D). None if the system is indeterminate.

        keys: the keys of all variables, in the order of their columns. variable: (D,) the index of each column in `keys`.
        order: (D,) the order of elimination, if it is known.
        """
        scale = np.sqrt(np.asarray(jacobian.power(2).sum(axis=0)).ravel())
        if not (np.isfinite(scale) & (scale > 0)).all():
            return None
        scaled = sparse.csr_matrix(jacobian @ sparse.diags_array(1 / scale))
        try:
            normal = NormalEquations.of(scaled, elimination_order(scaled, variable) if order is None else order)
        except SolveError:
            return None
        if not normal.least_pivot > LEAST_PIVOT:
            return None
        bounds = np.searchsorted(variable, np.arange(len(keys) + 1)).tolist()
        begin, end = (dict(zip(keys, ends, strict=True)) for ends in (bounds[:-1], bounds[1:]))
        return cls(normal, scale, begin, end)

    @property
    def log_determinant(self) -> float:
        """The log of the determinant of the normal equations."""
        return self.normal.log_determinant + 2 * float(np.log(self.scale).sum())

    def columns(self, keys: Sequence[int]) -> Ints:
        """Return the columns of variables, in the order of the keys."""
        return np.concatenate([np.arange(self.begin[key], self.end[key]) for key in keys])

    def blocks(self, groups: Sequence[Sequence[int]]) -> list[Floats]:
        """Return the block (d, d) of the inverse for each group of variables, in the order of their keys."""
        asked = [self.columns(group) for group in groups]
        late, block = self._late_block(np.unique(np.concatenate(asked)) if asked else np.zeros(0, dtype=np.int64))
        # A landmark that few poses see is eliminated early, and needs whole columns. The other landmarks still need none.
        in_block = [bool(np.isin(own, late).all()) for own in asked]
        alone = iter(self._by_columns([own for own, here in zip(asked, in_block, strict=True) if not here]))
        places = [np.searchsorted(late, own) for own in asked]
        return [block[np.ix_(at, at)] if here else next(alone) for at, here in zip(places, in_block, strict=True)]

    def _late_block(self, columns: Ints) -> tuple[Ints, Floats]:
        """Return the columns, among columns (n,), that are eliminated late, and their block of the inverse."""
        key = columns.tobytes()
        if key not in self.late_blocks:
            late = self.normal.late(columns, min(_DENSE, _EACH * len(columns)))
            dense = self.normal.last_block(late)
            self.late_blocks[key] = late, (dense + dense.T) / 2 / self.scale[late] / self.scale[late, None]
        return self.late_blocks[key]

    def _by_columns(self, asked: Sequence[Ints]) -> list[Floats]:
        """Return the block (d, d) of the inverse for each group of columns (d,), from whole columns of the inverse."""
        found: list[Floats] = []
        waiting: list[Ints] = []
        for i in range(len(asked)):
            waiting.append(asked[i])
            if sum(map(len, waiting)) < _COLUMNS and i + 1 < len(asked):
                continue
            at = np.concatenate(waiting)
            whole = np.zeros((len(self.scale), len(at)))
            whole[at, np.arange(len(at))] = 1 / self.scale[at]
            columns, first = self.normal.solve(whole), 0
            for own in waiting:
                block = columns[own, first : first + len(own)] / self.scale[own, None]
                found.append((block + block.T) / 2)
                first += len(own)
            waiting = []
        return found

    def times(self, at: Ints, right: Floats) -> Floats:
        """Return the product (d, m) of the block of the inverse at the columns `at` (d,) and vectors (d, m)."""
        late, block = self._late_block(at)
        if len(late) == len(at):
            return np.asarray(block @ right)
        whole = np.zeros((len(self.scale), right.shape[1]))
        whole[at] = right / self.scale[at, None]
        return np.asarray(self.normal.solve(whole)[at] / self.scale[at, None])
