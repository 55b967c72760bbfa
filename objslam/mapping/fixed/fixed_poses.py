"""Find objects and their positions at given poses. A calibration of the cameras can alternate with this."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from objslam.association.nearest_neighbour import associate_by_label
from objslam.config import Settings
from objslam.core.arrays import Floats
from objslam.core.calibration import Calibration
from objslam.core.camera import Camera
from objslam.core.diagnostics import Ledger
from objslam.core.trace import Parameters, Trace
from objslam.core.types import Association, Keyframes, Rays
from objslam.errors import SolveError
from objslam.frontend.shared_errors import SharedErrors
from objslam.mapping.progress import Progress

if TYPE_CHECKING:
    from objslam.core.estimate import Estimate
    from objslam.graph.calibration.fixed_pose_calibration import FixedCalibration

_ROUNDS = 12
"""The most rounds of association and calibration. Two or three are usual. A clock that is off by a second moves by 0.03 s in
a round, so it needs ten to reach its bound. More rounds are slower if they do not settle."""
_SAME = 0.05
"""An association is repeated only if ray directions, or their noise, differ from those of each earlier round by more than
this share of the noise. Such a small change moves hardly any ray across a gate, and a cycle of rounds repeats itself. A
larger share ends sooner. A limit in standard deviations of the shared errors does not work: with precise errors, the
association can swing between two states for ever."""
_EXPLAINED = 0.5
"""If an association with wide gates explains at most this share of the rays, one with narrow gates is tried as well. The
narrow one is taken if the wide one explains less than this share of its number of rays. With a larger share, the narrow one
is tried and taken more often."""


@dataclass(frozen=True)
class FixedPoses:
    """The input of an association at given poses.

    frames, rays: all keyframes with a pose, also without rays. seen, rays_seen: the keyframes that have a ray, and the rays
    with indices into them.
    """

    frames: Keyframes
    rays: Rays
    seen: Keyframes
    rays_seen: Rays
    cameras: tuple[Camera, ...]
    settings: Settings

    def without(self, errors: SharedErrors, theta: Floats) -> FixedPoses:
        """Return the same input, corrected for the shared errors theta (P,)."""
        frames, rays, _ = errors.take(self.frames, self.rays).at(theta, drift=False)
        seen, rays_seen, _ = errors.at(theta, drift=False)
        return replace(self, frames=frames, rays=rays, seen=seen, rays_seen=rays_seen)

    def associate(self, more: Floats | float = 0.0) -> Association:
        """Associate the rays. more: (R,) rad, noise of the ray directions in addition to the noise of boxes and poses."""
        from objslam.association.global_association import associate_globally
        from objslam.graph.fixed_pose_triangulation import pose_noise

        settings = self.settings
        if settings.association.method == "by_label":
            return associate_by_label(self.rays_seen)
        sigma, place = pose_noise(self.rays, self.frames, settings)
        return associate_globally(
            self.rays,
            self.frames,
            self.cameras,
            settings,
            map_T_camera=self.frames.map_T_camera,
            sigma=np.hypot(sigma, more),
            position_sigma=place,
            seed=settings.seed,
        )

    def add_few(self, association: Association, estimate: Estimate | None, more: Floats | float = 0.0) -> Association:
        """Add the objects that can be found from few rays, if the poses are localised and the settings allow it.

        estimate: of the objects, None if there are none. more: as in `associate`."""
        from objslam.association.few_rays.additional_objects import add_few_ray_objects
        from objslam.graph.fixed_pose_triangulation import pose_noise

        settings = self.settings
        if association.existence is None or not (settings.association.few_rays and self.frames.localized_every):
            return association
        sigma, place = pose_noise(self.rays, self.frames, settings)
        placed = np.zeros((0, 3)) if estimate is None else np.where(estimate.solved[:, None], estimate.positions, np.nan)
        return add_few_ray_objects(
            self.rays,
            self.frames,
            self.cameras,
            settings,
            association,
            placed,
            map_T_camera=self.frames.map_T_camera,
            sigma=np.hypot(sigma, more),
            position_sigma=place,
            seed=settings.seed,
        )

    def solve(self, association: Association, trace: Trace | None, parameters: Parameters | None = None) -> Estimate:
        """Triangulate the objects of an association, and record a round. parameters: the shared errors that were removed."""
        from objslam.graph import batch_solver
        from objslam.graph.fixed_pose_triangulation import triangulate_at

        map_T_camera = self.seen.map_T_camera
        placed = triangulate_at(map_T_camera, self.seen, self.rays_seen, association, self.settings)
        if trace is not None:
            trace.base_T_camera = self.seen.base_T_camera
        estimate = batch_solver.solve_fixed(self.seen, self.rays_seen, association, placed, self.settings, trace)
        if trace is not None:
            if parameters is not None:
                trace.iteration("solve", estimate.cost_after, map_T_camera, estimate.positions, parameters)
            trace.end_round("fixed", association, estimate)
        return estimate


def calibrate_fixed(
    at: FixedPoses, errors: SharedErrors, ledger: Ledger, progress: Progress, trace: Trace | None
) -> tuple[FixedPoses, Association, Estimate, tuple[dict[str, int], ...]]:
    """Estimate the shared errors of cameras at known poses, in turns with the association and the objects.

    The association allows for the present uncertainty of the errors: first their prior, then the covariance of the last fit.
    The covariance of the errors is added to the covariance of the objects. Returns the input without the errors, the
    association, the estimate, and the number of objects in each round. If the errors cannot be estimated, they stay as they
    were, and the ledger gets a warning.
    """
    from objslam.graph.calibration.fixed_pose_calibration import calibrate_at_poses, noise_of_errors, turned_by_errors
    from objslam.graph.fixed_pose_triangulation import noise_of_poses

    calibration = Calibration(errors.names, errors.mean, errors.prior, np.sqrt(np.diagonal(errors.prior)))
    every = errors.take(at.frames, at.rays)
    noise = noise_of_poses(errors.keyframes, at.settings)
    told = noise_of_errors(every, calibration)
    rounds: tuple[dict[str, int], ...] = ()
    earlier: list[tuple[Floats, Floats]] = []
    own = np.hypot(errors.rays.sigma, noise[0])
    for number in range(_ROUNDS):
        progress(f"association, round {number + 1}", 0, 0)
        now = at.without(errors, calibration.values)
        association = now.associate(told)
        if (plain := _explains_far_more(now, association)) is not None:
            association = plain
        rounds = (*rounds, {"objects": association.count})
        progress("solve", 0, 0)
        estimate = now.solve(association, trace, _parameters(calibration))
        placed = np.where(estimate.solved[:, None], estimate.positions, np.nan)
        try:
            found = calibrate_at_poses(errors, association, placed, calibration.values, noise)
        except SolveError as error:
            ledger.warn(f"the shared errors could not be estimated, and stay as they were: {error}")
            return now, association, replace(estimate, calibration=calibration), rounds
        earlier.append((calibration.values, np.hypot(own, told)))
        calibration, told = found.calibration, noise_of_errors(every, found.calibration)
        allowed = np.hypot(own, told)
        if any(
            _rms(turned_by_errors(every, values, calibration.values) / before) < _SAME and _rms(allowed / before - 1) < _SAME
            for values, before in earlier
        ):
            break
    else:
        ledger.warn(f"the shared errors still change after {_ROUNDS} rounds of association")
    now = at.without(errors, calibration.values)
    estimate = now.solve(association, trace, _parameters(calibration))
    every_object = now.add_few(association, estimate, told)
    if every_object.count > association.count:
        association = every_object
        estimate = now.solve(association, trace, _parameters(calibration))
        placed = np.where(estimate.solved[:, None], estimate.positions, np.nan)
        sensitivity = calibrate_at_poses(errors, association, placed, calibration.values, noise).sensitivity
        found = replace(found, sensitivity=sensitivity)
    return now, association, _with_covariance(estimate, found), rounds


def _rms(values: Floats) -> float:
    return float(np.sqrt((values**2).mean()))


def _explains_far_more(at: FixedPoses, wide: Association) -> Association | None:
    """Return an association that allows for no shared errors, if it explains far more rays than the association `wide`.

    None if it does not, or if `wide` explains more than half of the rays (`_EXPLAINED`). `wide` allows for shared errors,
    which may be many times the noise of a ray. On a short drive among many objects of one label, such wide gates confuse all
    objects. If the true errors are small, the objects are found without this allowance.
    """
    explained = (wide.object >= 0).sum()
    if explained > _EXPLAINED * len(wide.object):
        return None
    plain = at.associate()
    return plain if (plain.object >= 0).sum() > explained / _EXPLAINED else None


def _with_covariance(estimate: Estimate, found: FixedCalibration) -> Estimate:
    """Return an estimate with the covariance of the shared errors added to its objects."""
    from objslam.graph.posterior.marginals import largest_sigma

    told = found.calibration
    covariance = estimate.covariance + found.sensitivity @ told.covariance @ np.swapaxes(found.sensitivity, 1, 2)
    covariance = (covariance + np.swapaxes(covariance, 1, 2)) / 2
    sigma, correlated = largest_sigma(covariance), np.nan_to_num(found.sensitivity @ told.root)
    return replace(estimate, covariance=covariance, seen_sigma=sigma, calibration=told, correlated=correlated)


def _parameters(calibration: Calibration) -> Parameters:
    return Parameters(calibration.names, calibration.values, calibration.sigma)
