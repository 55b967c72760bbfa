"""The result type of every solver."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Self

import numpy as np

from objslam.core.arrays import Bools, Floats
from objslam.core.bodies.tag_pose import TagPose
from objslam.core.calibration import Calibration
from objslam.core.noise import NoiseFactors


@dataclass(frozen=True)
class Estimate:
    """The result of a solve with K keyframes, N objects and R rays.

    map_T_base: (K, 4, 4). positions: (N, 3) m in map. covariance: (N, 3, 3) m^2, NaN for an object that was not solved.
    solved: (N,) whether the object was part of the graph. seen_sigma: (N,) m, the standard deviation of the object's
    position along its least certain axis, relative to a camera that saw the object. It does not contain the drift of the
    path. It is NaN for an object that was not solved. weight: (R,) robust weight of each ray in [0, 1]. A ray that is
    rejected or has no object weighs 0. cost_before: the error of the graph at the start of the first solve. cost_after: the
    error of the graph at the optimum of the last solve. For a solve by Eq. 1 (`triangulation.point_to_lines`), the error is
    the sum of the distances between rays and objects, m. calibration: the shared errors that were estimated, or None. The
    poses fit measurements that are corrected by these errors. noise: the estimated noise, None if none was estimated.
    box_offset: the standard deviation of the error that all box centres of an object share, divided by the object's size.
    None if boxes have no size. correlated: (N, 3, m) m, the part of the errors that is correlated between objects, as a
    factor of their joint covariance. It is 0 for an object that was not solved, and None if all objects are independent.
    tags: the rotation and the size of each fiducial that has them, by the index of its object. log_evidence: the log
    evidence of the association, up to a constant, for the comparison of associations of the same rays. -inf if unknown.
    uncalibrated: whether the estimation of the shared errors failed. If so, the covariances do not contain these errors.
    error_covariance: (N, 3, 3) m^2, the part of the covariance that was added by `with_errors`, None if nothing was added.
    moved_by_held: (N, 3, H) m, how far shared errors of the usual size may move the objects if the solve held these errors
    fixed. It is a factor of the objects' joint covariance, and `covariance` does not contain it yet. None if it was not
    computed.
    """

    map_T_base: Floats
    positions: Floats
    covariance: Floats
    seen_sigma: Floats
    solved: Bools
    weight: Floats
    cost_before: float
    cost_after: float
    iterations: int
    calibration: Calibration | None = None
    noise: NoiseFactors | None = None
    box_offset: float | None = None
    correlated: Floats | None = None
    tags: Mapping[int, TagPose] = field(default_factory=dict)
    log_evidence: float = float("-inf")
    uncalibrated: bool = False
    error_covariance: Floats | None = None
    moved_by_held: Floats | None = None

    def with_errors(self, more: Floats) -> Self:
        """Return the estimate with the covariances (N, 3, 3), m^2, that errors cause in addition to the noise of the
        rays."""
        before = np.zeros(more.shape) if self.error_covariance is None else self.error_covariance
        return replace(self, covariance=self.covariance + more, error_covariance=before + more)

    def of_objects(self, kept: Bools, rays: Bools) -> Self:
        """Return the estimate with only the objects of a mask `kept` (N,), at the same poses.

        rays: (R,) a mask. Rays outside of the mask weigh 0.
        """
        number = np.cumsum(kept) - 1
        return replace(
            self,
            positions=self.positions[kept],
            covariance=self.covariance[kept],
            seen_sigma=self.seen_sigma[kept],
            solved=self.solved[kept],
            weight=np.where(rays, self.weight, 0.0),
            correlated=None if self.correlated is None else self.correlated[kept],
            tags={int(number[i]): tag for i, tag in self.tags.items() if kept[i]},
            error_covariance=None if self.error_covariance is None else self.error_covariance[kept],
            moved_by_held=None if self.moved_by_held is None else self.moved_by_held[kept],
        )
