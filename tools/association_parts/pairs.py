"""The measure of an association that needs no positions."""

import numpy as np

from objslam.core.arrays import Ints


def pair_f1(found: Ints, truth: Ints) -> float:
    """Return the F1 of pairs of observations (R,). -1 in `found` means no landmark."""
    held = found >= 0
    table = np.zeros((found.max(initial=-1) + 1, truth.max() + 1))
    np.add.at(table, (found[held], truth[held]), 1)
    right, ours, theirs = (float((n * (n - 1) / 2).sum()) for n in (table, table.sum(axis=1), np.bincount(truth)))
    return 2 * right / max(ours + theirs, 1.0)
