"""Solve the normal equations of a sparse Jacobian. One elimination order serves all graphs of the same variables."""

from contextlib import suppress
from dataclasses import dataclass
from typing import Literal, Self

import numpy as np
from scipy import sparse
from scipy.linalg import solve_triangular
from scipy.sparse.linalg import SuperLU, splu

from objslam.core.arrays import Floats, Ints
from objslam.errors import SolveError
from objslam.graph.least_squares.chain import ChainEquations, ChainRows


@dataclass(frozen=True)
class NormalEquations:
    """The factorised normal equations J^T J of a Jacobian (M, D). order: (D,) its columns, in the order of elimination."""

    order: Ints
    factored: SuperLU

    @classmethod
    def of(cls, jacobian: sparse.csr_matrix, order: Ints) -> Self:
        """Factor the normal equations. SolveError if they are singular."""
        return cls(order, _factored(_reordered(jacobian, order), "NATURAL"))

    @property
    def least_pivot(self) -> float:
        """The smallest pivot. If it is small compared with the entries of J^T J, the elimination has lost many digits."""
        return float(self.factored.U.diagonal().min())

    @property
    def log_determinant(self) -> float:
        """The log of the determinant of J^T J."""
        return float(np.log(self.factored.U.diagonal()).sum())

    def solve(self, right: Floats) -> Floats:
        """Return the solution (D,) or (D, n) for a right-hand side (D,) or (D, n)."""
        found = np.empty_like(right)
        found[self.order] = self.factored.solve(right[self.order])
        return found

    def late(self, columns: Ints, most: int) -> Ints:
        """Return the subset of `columns` (n,) that is among the last `most` eliminated columns. `last_block` takes this
        subset."""
        straight = np.arange(len(self.order))
        if not all(np.array_equal(p, straight) for p in (self.factored.perm_c, self.factored.perm_r)):
            return columns[:0]
        return columns[np.isin(columns, self.order[-most:])] if most else columns[:0]

    def last_block(self, columns: Ints) -> Floats:
        """Return the block (n, n) of the inverse at some columns (n,), which are `late`.

        Let J^T J = L U, and so U = D L^T. The last block of the inverse is the inverse of the product of the last blocks of
        L and U. Landmarks are eliminated late, because many poses see them. So their covariances come from a small dense
        triangle. `solve` would go through all poses for each column.
        """
        if not len(columns):
            return np.zeros((0, 0))
        rank = np.empty_like(self.order)
        rank[self.order] = np.arange(len(self.order))
        first = int(rank[columns].min())
        lower, pivots = self.factored.L[first:, first:].toarray(), self.factored.U.diagonal()[first:]
        asked = np.zeros((len(lower), len(columns)))
        asked[rank[columns] - first, np.arange(len(columns))] = 1.0
        half = solve_triangular(lower, asked, lower=True, unit_diagonal=True, check_finite=False)
        return np.asarray(half.T @ (half / pivots[:, None]))


Equations = NormalEquations | ChainEquations
"""The factorised normal equations of any graph, or of a chain of poses."""


def factored(jacobian: sparse.csr_matrix, chain: ChainRows | None, blocks: Ints, order: Ints | None) -> Equations:
    """Factor the normal equations of a Jacobian (M, D). SolveError if they are singular.

    chain: the same rows, if the poses of the graph form a chain, which takes less time to factor. None for other graphs.
    blocks: (D,) the variable of each column. order: (D,) the order of elimination of a general factorisation, if it is
    known.
    """
    if chain is not None:
        with suppress(np.linalg.LinAlgError):
            return ChainEquations.of(chain)
    return NormalEquations.of(jacobian, elimination_order(jacobian, blocks) if order is None else order)


def elimination_order(jacobian: sparse.csr_matrix, blocks: Ints) -> Ints:
    """Return the columns (D,) of a Jacobian (M, D) in an order whose elimination gives little fill-in (minimum degree).

    blocks: (D,) the variable of each column, from 0. The columns of a variable stay together. So the order stays good if
    some entries of the Jacobian are zero at one set of values only.
    """
    pattern = sparse.csr_matrix((np.ones(jacobian.nnz), blocks[jacobian.indices], jacobian.indptr), copy=True)
    pattern.sum_duplicates()
    pattern.data[:] = 1.0
    coupled = sparse.csc_matrix(pattern.T @ pattern)
    dominant = sparse.diags_array(np.full(coupled.shape[0], 1.0 + float(coupled.sum(axis=0).max())))
    rank = _factored(sparse.csc_matrix(coupled + dominant), "MMD_AT_PLUS_A").perm_c  # By variable: its place in the order.
    return np.argsort(rank[blocks], kind="stable")


def _reordered(jacobian: sparse.csr_matrix, order: Ints) -> sparse.csc_matrix:
    """Return J^T J with its rows and columns in another order. The entries of a column are in no order."""
    rank = np.empty(len(order), dtype=jacobian.indices.dtype)
    rank[order] = np.arange(len(order))
    moved = sparse.csr_matrix((jacobian.data, rank[jacobian.indices], jacobian.indptr), shape=jacobian.shape)
    product = sparse.csc_matrix(moved.T @ moved)
    product.has_sorted_indices = True  # Otherwise, scipy sorts them, as slowly as the product. SuperLU needs no order.
    return product


def _factored(matrix: sparse.csc_matrix, columns: Literal["NATURAL", "MMD_AT_PLUS_A"]) -> SuperLU:
    """Factor a symmetric positive definite matrix. SolveError if it is singular."""
    try:
        return splu(
            matrix, permc_spec=columns, diag_pivot_thresh=0.0, relax=1, panel_size=1, options={"SymmetricMode": True}
        )
    except RuntimeError as error:
        raise SolveError(f"the linear system has no single solution: {error}") from error
