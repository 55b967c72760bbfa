"""The solution of a log, and the measurements that belong to it."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from objslam.config import Settings
from objslam.core.arrays import Bools, Floats, Ints
from objslam.core.bodies.body import PlacedBody
from objslam.core.trace import Round
from objslam.core.types import Association, Keyframes, Rays
from objslam.frontend.localization.localization_jumps import Jumps
from objslam.frontend.shared_errors import SharedErrors

if TYPE_CHECKING:
    from objslam.core.estimate import Estimate


@dataclass(frozen=True)
class RangeShift:
    """The corrections that make R ranges end at the centres of bodies instead of on their surfaces.

    A range is corrected if a body shows how far the centre of its object lies behind the surface (`range_shift`).

    factor: (R,) the factor on the range. bias: (R,) the factor on `Rays.range_bias`. Both are 1 for a range that is not
    corrected. surface: (R, 2) the new `Rays.surface`, NaN for a range that is not corrected.
    """

    factor: Floats
    bias: Floats
    surface: Floats

    @classmethod
    def none(cls, count: int) -> RangeShift:
        """Return the corrections of `count` ranges that change nothing."""
        return cls(np.ones(count), np.ones(count), np.full((count, 2), np.nan))

    @property
    def told(self) -> Bools:
        """A mask (R,) of the ranges for which a body shows how far the centre lies behind the surface."""
        return np.isfinite(self.surface[:, 0])

    def only(self, rays: Bools) -> RangeShift:
        """Return the same corrections for the ranges in a mask (R,), and none for the others."""
        factor, bias = np.where(rays, self.factor, 1.0), np.where(rays, self.bias, 1.0)
        return RangeShift(factor, bias, np.where(rays[:, None], self.surface, np.nan))

    def apply(self, rays: Rays, settings: Settings) -> Rays:
        """Return the rays with ranges to the centres of bodies."""
        if not self.told.any():
            return rays
        before = np.tile([settings.depth.centre, 1.0], (len(rays), 1)) if rays.surface is None else rays.surface
        return replace(
            rays,
            range=rays.range * self.factor,
            range_bias=rays.range_bias * self.bias,
            surface=np.where(self.told[:, None], self.surface, before),
        )


@dataclass(frozen=True)
class CentreShift:
    """The corrections that turn R rays to the centres of bodies.

    direction: (R, 3), the vector to add to the unit direction of each ray, in the camera frame. sigma: (R,) rad, the noise
    that the correction adds. It is 0 unless something hides a part of the object in the image. ranges: the corrections of
    the ranges to the same centres, None if no range is corrected.
    """

    direction: Floats
    sigma: Floats
    ranges: RangeShift | None = None

    def only(self, rays: Bools) -> CentreShift:
        """Return the same corrections for the rays in a mask (R,), and none for the others."""
        ranges = None if self.ranges is None else self.ranges.only(rays)
        return CentreShift(np.where(rays[:, None], self.direction, 0.0), np.where(rays, self.sigma, 0.0), ranges)

    def apply(self, rays: Rays) -> Rays:
        """Return the rays turned to the centres of bodies. Their ranges do not change."""
        direction = rays.direction + self.direction
        direction = direction / np.linalg.norm(direction, axis=1, keepdims=True)
        return replace(rays, direction=direction, sigma=np.hypot(rays.sigma, self.sigma))


@dataclass(frozen=True)
class Solution:
    """The solved association and estimate, with the keyframes and rays that were solved.

    keyframes: all keyframes with at least one ray. rays: the rays, with indices into these keyframes. rounds: the counts of
    each round of association and solve. trace: the rounds in detail, empty without a recording. bodies: the body of each
    object, None for a point. to_centre: the correction that turns each ray to the centre of its body. hidden: (R,) whether
    something may hide a part of the object in the box of each ray. bodies, to_centre and hidden are None if no bodies were
    solved. doubted: the labels that may name one object or several. unsettled: the number of objects that the last round
    changed (`objects_changed`), if no further round was allowed. unfinished: whether the search for a clear map ended early,
    after its solves (`joint.max_solves`) or at an interrupt. copied: the number of objects in the largest part of the map
    that shows the same things as another part. errors: the shared errors that were estimated, None if none were. They
    include held errors that were found to be gross. whole: in fixed mode, the association before things that move along the
    view were dropped. A joint solve begins better with it, because the joint solve finds such things again at its own poses.
    """

    keyframes: Keyframes
    rays: Rays
    association: Association
    estimate: Estimate
    rounds: tuple[dict[str, int], ...]
    trace: tuple[Round, ...] = ()
    bodies: tuple[PlacedBody | None, ...] | None = None
    to_centre: CentreShift | None = None
    hidden: Bools | None = None
    doubted: tuple[str, ...] = ()
    unsettled: int = 0
    unfinished: bool = False
    copied: int = 0
    errors: SharedErrors | None = None
    whole: Association | None = None


def as_centres(solution: Solution) -> Solution:
    """Return a solution at given poses with its rays turned to the centres of bodies, and its objects at these centres. The
    covariances do not change.

    An object whose body gives no centre keeps its rays and its position."""
    bodies = solution.bodies or ()
    centres = {j: body.centre for j, body in enumerate(bodies) if body is not None and body.centre is not None}
    if solution.to_centre is None or not centres:
        return solution
    estimate, turned = solution.estimate, list(centres)
    positions = estimate.positions.copy()
    positions[turned] = list(centres.values())
    shift = solution.to_centre.only((estimate.weight > 0) & np.isin(solution.association.object, turned))
    return replace(solution, rays=shift.apply(solution.rays), estimate=replace(estimate, positions=positions))


def without_errors(errors: SharedErrors, estimate: Estimate) -> tuple[Keyframes, Rays]:
    """Return the keyframes and rays with the shared errors of an estimate removed, and with the noise of the estimate."""
    values = errors.mean if estimate.calibration is None else estimate.calibration.values
    keyframes, rays, _ = with_noise_of(errors, estimate).at(values)
    return keyframes, rays


def with_noise_of(errors: SharedErrors, estimate: Estimate) -> SharedErrors:
    """Return shared errors with the noise of an estimate, but without its shrinkage.

    The shrinkage is an effect of a solve on lengths (`NoiseFactors`). Outside a solve, lengths stay as measured.
    """
    noise = errors.noise if estimate.noise is None else estimate.noise
    return errors.with_noise(replace(noise, shrinkage=0.0))


def with_jumps(solution: Solution, jumps: Jumps) -> Solution:
    """Return the solution with larger covariances, for the error that is left after `jumps` were removed from the poses. All
    objects share this error."""
    estimate, association, rays = solution.estimate, solution.association, solution.rays
    used = np.flatnonzero((estimate.weight > 0) & (association.object >= 0))
    keyframe = rays.keyframe[used]
    origins = solution.keyframes.map_T_camera[keyframe, :3, 3]
    stamps = solution.keyframes.stamps[keyframe]
    factor = jumps.spread(stamps, origins, association.object[used], estimate.positions)
    estimate = estimate.with_errors(factor @ np.swapaxes(factor, 1, 2))
    factor = np.nan_to_num(factor)
    correlated = factor if estimate.correlated is None else np.concatenate([estimate.correlated, factor], axis=2)
    return replace(solution, estimate=replace(estimate, correlated=correlated))


def seen_something(keyframes: Keyframes, rays: Rays) -> tuple[Keyframes, Rays]:
    """Return the keyframes that have a ray, and the rays with indices into these keyframes."""
    kept, keyframe = np.unique(rays.keyframe, return_inverse=True)
    return keyframes.take(kept), replace(rays, keyframe=keyframe.astype(np.int64))


def rays_moved(before: Ints, after: Ints) -> int:
    """Return how many rays changed their object. before, after: (R,) the object of each ray, -1 for none. Renumbered objects
    count as the same."""
    stayed = _same_objects(before, after)[2].sum() + ((before < 0) & (after < 0)).sum()
    return len(before) - int(stayed)


def objects_changed(before: tuple[Association, Estimate], after: tuple[Association, Estimate]) -> int:
    """Return how many objects changed between two solved associations: they are new, are gone, or moved by more than their
    sigma.

    A sigma holds only if the association is right. Rays that change their objects can move an object by more than its sigma.
    Then the place of the object is less certain than the sigma says. A few rays that go back and forth between neighbours
    hardly move an object.
    """
    (first, was), (second, now) = before, after
    i, j, _ = _same_objects(first.object, second.object)
    solved = was.solved[i] & now.solved[j]
    moved, covariance = (now.positions[j] - was.positions[i])[solved], now.covariance[j][solved]
    squared = np.einsum("ni,ni->n", moved, np.linalg.solve(covariance, moved[..., None])[..., 0])
    return first.count + second.count - 2 * len(i) + int((squared > 1.0).sum())


def _same_objects(before: Ints, after: Ints) -> tuple[Ints, Ints, Ints]:
    """Return the indices (n,) before and (n,) after of the objects that are the same, and the number (n,) of rays that they
    share.

    before, after: (R,) the object of each ray, -1 for none.
    """
    from scipy.optimize import linear_sum_assignment

    shared = np.zeros((before.max(initial=-1) + 1, after.max(initial=-1) + 1), dtype=np.int64)
    both = (before >= 0) & (after >= 0)
    np.add.at(shared, (before[both], after[both]), 1)
    i, j = linear_sum_assignment(shared, maximize=True)
    some = shared[i, j] > 0
    return i[some], j[some], shared[i, j][some]
