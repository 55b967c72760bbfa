"""The covariances of a map after its alignment with the truth.

The alignment removes the part of the shared errors that a transform can express. It also spreads a little of each object's
own error over all other objects. The remaining errors therefore have another covariance than in the map. The squared
Mahalanobis distances after an alignment must use this covariance to show whether the covariances of the map are right.
"""

import numpy as np

from objslam.core.arrays import Floats
from objslam.core.maps.shared_covariance import jacobian, own_part, root_of
from objslam.evaluation.alignment import Alignment, Transform

_ROTATIONS = {"se2": (2,), "sim2": (2,), "se3": (0, 1, 2), "sim3": (0, 1, 2)}
"""The indices of the axes (x, y, z) about which each alignment turns the map."""
_UNDETERMINED = 1e-6
"""The least effect of a motion on the objects, as a share of the largest effect. An alignment leaves out motions with a
smaller effect, such as a turn about a line on which all objects lie. A larger value leaves out more motions."""


def aligned_covariances(
    points: Floats, covariance: Floats, shared: Floats | None, transform: Transform, kind: Alignment
) -> Floats:
    """Return the covariances (N, 3, 3), m^2, of the errors that a least-squares alignment of N objects leaves.

    Args:
        points: (N, 3) positions of the matched objects in map, m.
        covariance: (N, 3, 3) covariances of the positions in map, m^2.
        shared: (7, 7) covariance of the errors that the objects share, None if the errors are independent.
        transform: the alignment, from map to truth.
        kind: the kind of the alignment.
    """
    turn = transform.scale * transform.pose[:3, :3]
    if kind == "none" or len(points) == 0:
        return np.asarray(turn @ covariance @ turn.T)
    factor = np.zeros((len(points), 3, 0)) if shared is None else jacobian(points) @ root_of(shared)
    own = covariance if shared is None else own_part(covariance, factor)
    own, factor = turn @ own @ turn.T, turn @ factor
    moved = transform.apply(points)
    lever = jacobian(moved - moved.mean(axis=0))
    free = [0, 1, 2]  # The alignment shifts the map, and with enough objects it turns and scales it.
    if len(points) >= (3 if "3" in kind else 2):
        free += [3 + axis for axis in _ROTATIONS[kind]] + ([6] if kind.startswith("sim") else [])
    effect = lever[:, :, free]
    told = effect.copy()
    if kind == "sim2" and 6 in free:
        told[:, 2, -1] = 0.0  # sim2 computes the scale only from x and y.
    flat = told.reshape(-1, len(free))
    size = np.maximum(np.linalg.norm(flat, axis=0), 1e-12)
    gain = (np.linalg.pinv(flat / size, rcond=_UNDETERMINED) / size[:, None]).reshape(len(free), len(points), 3)
    # The error e of all objects becomes e - effect (gain e).
    moves = np.einsum("dni,nij->dnj", gain, own) + np.einsum("dm,njm->dnj", _common(gain, factor), factor)
    spread = np.einsum("dnj,enj->de", moves, gain)
    crossed = np.einsum("nid,dnj->nij", effect, moves)
    whole = own + factor @ np.swapaxes(factor, 1, 2) - crossed - np.swapaxes(crossed, 1, 2)
    return np.asarray(whole + effect @ spread @ np.swapaxes(effect, 1, 2))


def _common(gain: Floats, factor: Floats) -> Floats:
    """Return the effect (d, m) of m shared errors on the d motions of the alignment. gain: (d, N, 3). factor: (N, 3, m)."""
    return np.asarray(np.einsum("dni,nim->dm", gain, factor))
