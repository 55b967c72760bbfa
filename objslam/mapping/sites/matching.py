"""Match the objects of two maps in one frame, by position and label. Labels count only as far as they can be trusted."""

import numpy as np
from scipy.spatial import KDTree

from objslam.association.gating import pair_up
from objslam.core.arrays import Floats, Ints
from objslam.core.object_map import MapObject
from objslam.core.statistics import SAME_POINT

STILL = 0.05
"""The standard deviation (m) by which the position of an object that stayed differs between sessions. Somebody nudges the
object, or its boxes differ. With a larger value, more shifted objects count as unmoved."""
_MISLABELLED = 0.02
"""The probability that a detector gives an object a particular wrong label. With a larger value, objects with different
labels match over a larger distance."""


def same_objects(
    ours: list[MapObject], theirs: list[MapObject], positions: Floats, covariance: Floats, other: Floats, other_cov: Floats
) -> Ints:
    """Return the pairs (P, 2) of indices into `ours` and `theirs` that are one object. The matching is one-to-one.

    The matching has the largest sum of gains. The gain of a pair is `SAME_POINT` minus the cost of the pair, and must be
    positive. The cost is the squared Mahalanobis distance, minus 2 ln of `label_agreement`. positions, covariance: (N, 3) m
    and (N, 3, 3) m^2 of `ours`. other, other_cov: (M, 3) m and (M, 3, 3) m^2 of `theirs`, in the same frame.
    """
    if not len(ours) or not len(theirs):
        return np.zeros((0, 2), dtype=np.int64)
    widest = [float(np.linalg.eigvalsh(c)[:, -1].max()) for c in (covariance, other_cov)]
    reach = float(np.sqrt(SAME_POINT * (sum(widest) + STILL**2)))
    near = KDTree(positions).sparse_distance_matrix(KDTree(other), reach, output_type="coo_matrix")
    i, k = (np.asarray(rows, dtype=np.int64) for rows in (near.row, near.col))
    apart = positions[i] - other[k]
    spread = covariance[i] + other_cov[k] + STILL**2 * np.eye(3)
    squared = np.einsum("pi,pi->p", apart, np.linalg.solve(spread, apart[..., None])[..., 0])
    labels = np.array([label_agreement(ours[a], theirs[b]) for a, b in zip(i.tolist(), k.tolist(), strict=True)])
    cost = squared - 2 * np.log(labels.reshape(-1))
    may = cost < SAME_POINT
    pairs = pair_up(i[may], k[may], SAME_POINT - cost[may], (len(ours), len(theirs)))
    return np.column_stack(pairs).astype(np.int64)


def label_agreement(a: MapObject, b: MapObject) -> float:
    """Return the probability that both objects have the same label, from their label shares. It is at least
    `_MISLABELLED`."""
    shares = [o.labels or {o.label: 1.0} for o in (a, b)]
    both = sum(share * shares[1].get(name, 0.0) for name, share in shares[0].items())
    return max(min(both, 1.0), _MISLABELLED)
