"""The rows of the motions that a localisation with lasting errors measures."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from objslam.core.arrays import Floats, Ints
from objslam.core.geometry import adjoint, inverse, log_se3
from objslam.graph.factors.localization import LocalizedMotions
from objslam.graph.factors.residual_algebra import by_end, huber_roots, whitening


@dataclass(frozen=True)
class LocalizedRows:
    """The between-factors of `LocalizedMotions` as six rows each. first_pose: the first column of the poses."""

    of: LocalizedMotions
    first_pose: int

    @property
    def rows_each(self) -> int:
        """The number of rows of one motion."""
        return 6

    @property
    def columns(self) -> Ints:
        """(s, 12) the columns of the poses before and after each motion."""
        columns = [6 * pose[:, None] + np.arange(6) for pose in (self.of.before, self.of.after)]
        return self.first_pose + np.hstack(columns)

    @cached_property
    def roots(self) -> Floats:
        """(s, 6, 6) upper triangular matrices that whiten the motions."""
        return whitening(self.of.covariance)

    def weighted_roots(self, map_T_camera: Floats) -> Floats:
        """Return `roots` times the roots of Huber's weights at poses (P, 4, 4)."""
        off = log_se3(inverse(self.of.motion) @ self.moved(map_T_camera))
        weight, _ = huber_roots(np.linalg.norm((self.roots @ off[..., None])[..., 0], axis=1))
        return self.roots * weight[:, None, None]

    def moved(self, map_T_camera: Floats) -> Floats:
        """Return the motions (s, 4, 4) between the poses (P, 4, 4)."""
        return np.asarray(inverse(map_T_camera[self.of.before]) @ map_T_camera[self.of.after])

    def rows(self, map_T_camera: Floats, landmarks: Floats) -> tuple[Floats, Floats, float]:
        """Return the whitened residuals (s, 6) at poses (P, 4, 4), their derivatives (s, 6, 12), and the cost. The landmarks
        are not used."""
        moved = self.moved(map_T_camera)
        off = log_se3(inverse(self.of.motion) @ moved)
        white = (self.roots @ off[..., None])[..., 0]
        weight, cost = huber_roots(np.linalg.norm(white, axis=1))
        after = weight[:, None, None] * self.roots @ by_end(off)
        before = -after @ adjoint(inverse(moved))
        return weight[:, None] * white, np.concatenate([before, after], axis=2), float(cost.sum())
