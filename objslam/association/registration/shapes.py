"""The shape of a map: where its objects lie relative to each other, and which errors of the objects a transform of the map
can absorb.

The error of object i is L_i e + o_i. The object has o_i alone. All objects of the map share e, which has seven numbers: a
shift, a rotation and a size (`core.maps.shared_covariance`). The transform x between two maps is a shift and a yaw. So e has
two parts: g is its shift and its yaw, which x can absorb, and d is its tilt and its size. J_i and D_i are the columns of L_i
that belong to g and to d. Object i has a partner in the other map. To first order, its offset from this partner is

    y_i = J_i x + J_i g + D_i d + o_i.

A change of g looks exactly like a change of x, and nothing else is known about x. Three things follow.

1. The residuals of a fit of x do not depend on g. So the covariance of an offset contains only o_i + D_i d. Gates with more
   than this covariance would be too wide, and would take chance matches for true matches.
2. The best estimate of x does not change if the covariance of the offsets contains g as well (Rao 1967). Each fit moves a
   start x_0 to x_0 + sum_i K_i (y_i - J_i x_0), with weights K_i for which sum_i K_i J_i = 1. So its error is
   g + sum_i K_i (D_i d + o_i). The whole covariance of g is therefore added to the covariance of x. It does not become
   smaller if more objects match.
3. Let p_i be the position of object i. The vector p_j - p_i from object i to object j has the error
   o_j - o_i + turn x (p_j - p_i) + size (p_j - p_i), where "turn" and "size" are the rotation and the size of e. The shift
   of e does not change the vector. The yaw of e changes neither its horizontal length nor its rise.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from objslam.association.place_recognition import Constellation
from objslam.core.arrays import Floats, Ints
from objslam.core.maps.shared_covariance import NUMBERS, SIZE, jacobian, moved, own_part, root_of

_FLOOR = 0.01
"""The standard deviation (m) added to each position, so that exact maps can be registered. A larger value matches more
objects."""
STRAIN = [3, 4, SIZE]
"""The numbers of a shared error that a shift and a yaw do not absorb: the tilt about x and y, and the size."""


@dataclass(frozen=True)
class Shape:
    """N objects of a map, relative to their centre.

    position: (N, 3) m. label: (N,). own: (N, 3, 3) m^2, the error that each object has alone. shared: (7, 7) the covariance
    of the error that all objects share, about the centre, 0 if it is not known. covariance: (N, 3, 3) m^2, of the
    own error and of the part of the shared error that no shift and no yaw absorbs. centre: (3,) m in the frame of the map.
    """

    position: Floats
    label: Ints
    own: Floats
    shared: Floats
    covariance: Floats
    centre: Floats

    @property
    def size_variance(self) -> float:
        """The variance of the logarithm of the size of the map."""
        return float(self.shared[SIZE, SIZE])

    @property
    def tilt_variance(self) -> float:
        """The largest variance (rad^2) of a tilt of the map about any level axis."""
        return float(np.linalg.eigvalsh(self.shared[3:5, 3:5])[-1])

    def vectors(self, i: Ints, j: Ints) -> Vectors:
        """Return the vectors from objects i (P,) to objects j (P,)."""
        base = self.position[j] - self.position[i]
        length = np.hypot(base[:, 0], base[:, 1])
        own = self.own[i] + self.own[j]
        along = base[:, :2] / np.maximum(length, 1e-12)[:, None]
        lever = jacobian(base)[:, :, 3:]
        level = np.einsum("pi,pik->pk", along, lever[:, :2])  # The derivatives of the length by turn and size.
        rise = lever[:, 2]
        turn = self.shared[3:, 3:]
        return Vectors(
            base,
            length,
            np.einsum("pi,pij,pj->p", along, own[:, :2, :2], along) + np.einsum("pk,kl,pl->p", level, turn, level),
            own[:, 2, 2] + np.einsum("pk,kl,pl->p", rise, turn, rise),
        )


@dataclass(frozen=True)
class Vectors:
    """P vectors between objects of one map.

    base: (P, 3) m, the vectors. length: (P,) m, the length of their horizontal part. length_variance, rise_variance: (P,)
    m^2, the variances of this length and of the vertical part.
    """

    base: Floats
    length: Floats
    length_variance: Floats
    rise_variance: Floats


def shape_of(whole: Constellation, keep: Ints, shared: Floats | None) -> Shape:
    """Return the shape of the objects `keep` (N,) of a map.

    shared: (7, 7) the covariance of the shared error, in the frame of the map. The covariances of `whole` contain this
    error. `shared` is None if it is not known. The standard deviation `_FLOOR` is added to each own error.
    """
    centre = whole.position[keep].mean(axis=0)
    back = np.eye(4)
    back[:3, 3] = -centre
    at_centre = np.zeros((NUMBERS, NUMBERS)) if shared is None else moved(shared, back)
    position = whole.position[keep] - centre
    own = own_errors(position, whole.covariance[keep], at_centre) + _FLOOR**2 * np.eye(3)
    return Shape(position, whole.label[keep], own, at_centre, own + strain(position, at_centre), centre)


def own_errors(position: Floats, covariance: Floats, shared: Floats) -> Floats:
    """Return the covariances (N, 3, 3), m^2, of the errors that objects have alone.

    position: (N, 3) m. covariance: (N, 3, 3) m^2, with the shared error. shared: (7, 7) its covariance.
    """
    return own_part(covariance, jacobian(position) @ root_of(shared)) if shared.any() else covariance


def strain(position: Floats, shared: Floats) -> Floats:
    """Return the covariances (N, 3, 3), m^2, of the errors that the tilt and the size of a map cause at objects.

    position: (N, 3) m, relative to the centre of the map. shared: (7, 7) the covariance of the shared error.
    """
    lever = jacobian(position)[:, :, STRAIN]
    return np.asarray(lever @ shared[np.ix_(STRAIN, STRAIN)] @ np.swapaxes(lever, 1, 2))
