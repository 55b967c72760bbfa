"""The factorised normal equations against dense matrices."""

import numpy as np
from scipy import sparse

from objslam.graph.least_squares.normal_equations import NormalEquations, elimination_order


def chain(poses: int = 60, seen_by_all: int = 4) -> sparse.csr_matrix:
    """The Jacobian of a chain of numbers, each of which sees all of a few others, which come first."""
    rng = np.random.default_rng(0)
    steps = sparse.diags_array([-np.ones(poses - 1), np.ones(poses - 1)], offsets=[0, 1], shape=(poses - 1, poses))
    sight = sparse.hstack([rng.normal(size=(poses, seen_by_all)), sparse.eye_array(poses)])
    weak = 0.1 * sparse.eye_array(seen_by_all + poses)
    return sparse.csr_matrix(
        sparse.vstack([sparse.hstack([sparse.csr_array((poses - 1, seen_by_all)), steps]), sight, weak])
    )


def test_the_last_block_of_the_inverse_is_that_of_the_dense_matrix(monkeypatch):
    """It comes from a triangle. The inverse of a dense matrix takes ten times as long for 200 of 1500 columns."""
    jacobian = chain()
    normal = NormalEquations.of(jacobian, elimination_order(jacobian, np.arange(jacobian.shape[1])))
    inverse = np.linalg.inv((jacobian.T @ jacobian).toarray())
    columns = np.array([2, 0])
    assert normal.late(columns, 20).tolist() == [2, 0]
    with monkeypatch.context() as patched:
        patched.setattr(np.linalg, "inv", None)
        found = normal.last_block(columns)
    np.testing.assert_allclose(found, inverse[np.ix_(columns, columns)], rtol=1e-9)
    first = normal.order[0]  # It is eliminated first.
    assert normal.late(np.array([2, first, 0]), 20).tolist() == [2, 0]
    assert not len(normal.last_block(normal.late(np.array([first]), 20)))
