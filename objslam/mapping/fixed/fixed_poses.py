"""Find objects and their positions at given poses."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from objslam.association.nearest_neighbour import associate_by_label
from objslam.association.observations import PosedRays
from objslam.config import Settings
from objslam.core.arrays import Floats
from objslam.core.camera import Camera
from objslam.core.noise import NoiseFactors
from objslam.core.trace import Parameters, Trace
from objslam.core.types import Association, Keyframes, Rays
from objslam.frontend.shared_errors import SharedErrors
from objslam.mapping.fixed.pose_noise import noise_in_frames
from objslam.mapping.moves.moving_things import things_at_rest, without_things
from objslam.mapping.progress import Progress
from objslam.mapping.solution import seen_something

if TYPE_CHECKING:
    from objslam.core.estimate import Estimate

MOST_ROUNDS = 12
"""The most rounds of association and calibration. Two or three are usual. The estimate of a clock that is off by a second
moves by 0.03 s in a round, so it reaches its bound after ten rounds. With a larger number, logs that do not settle take
longer."""
SAME = 0.05
"""The largest difference from an earlier round, as a share of the noise, at which the rounds end. It is the difference of
ray directions and of their noise. A smaller change moves hardly any ray across a gate, and a return to an earlier round
would repeat itself. With a larger share, the rounds end sooner. A limit in standard deviations of the shared errors does not
work. If these are precise, the association can alternate between two states for ever."""
_FIRST = 0.05
"""The noise (rad) of ray directions that a first association adds to the noise in the settings. The noise of the poses is
then estimated from this association. The priors of the shared errors of a camera allow errors of about this size. With a
larger value, neighbouring objects become one, and their rays no longer show the noise of the poses."""


@dataclass(frozen=True)
class FixedPoses:
    """The input of an association at given poses.

    frames: all keyframes with a pose, with and without rays. rays: the rays, with indices into `frames`. seen: the keyframes
    that have a ray. rays_seen: the rays, with indices into `seen`.
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
        seen, rays_seen = seen_something(frames, rays)
        corrected = replace(self, frames=frames, rays=rays, seen=seen, rays_seen=rays_seen)
        return corrected.with_noise_of_poses(self.seen.pose_noise)

    def with_noise_of_poses(self, factors: tuple[float, float]) -> FixedPoses:
        """Return the same input with factors on `localization.yaw` and `localization.xy`."""
        return replace(self, frames=replace(self.frames, pose_noise=factors), seen=replace(self.seen, pose_noise=factors))

    @property
    def noise_unknown(self) -> bool:
        """Whether the noise of the poses is estimated. The poses must be localised, and `noise.localization` must ask for
        it."""
        return bool(self.frames.localized_every and self.settings.finds_localization_noise)

    def noise_of_poses(self, association: Association, positions: Floats, weight: Floats) -> tuple[float, float]:
        """Return the factors on `localization.yaw` and `localization.xy` that the rays show, 1 if they are not estimated.

        positions: (N, 3) m, NaN for an object without a position. weight: (R,) the weight of each ray. Rays of weight 0 were
        rejected, and do not count."""
        if not self.noise_unknown:
            return 1.0, 1.0
        agreeing = replace(association, object=np.where(weight > 0, association.object, -1))
        return noise_in_frames(self.seen, self.rays_seen, agreeing, positions, self.settings)

    def associate(self, more: Floats | float = 0.0, guess: tuple[Association, Floats] | None = None) -> Association:
        """Return an association of the rays. more: (R,) rad, noise of the ray directions in addition to the noise of boxes
        and poses.

        guess: an association at nearly these poses, and the positions (N, 3) m of its objects. The search begins at this
        guess.
        """
        from objslam.association.global_association import associate_globally

        if self.settings.association.method == "by_label":
            return associate_by_label(self.rays_seen)
        of, seed = self._posed(more), self.settings.seed
        return associate_globally(of, self.settings, seed=seed, guess=guess, repaired=guess is not None)

    def completed(
        self,
        association: Association,
        estimate: Estimate,
        trace: Trace | None,
        parameters: Parameters | None = None,
        more: Floats | float = 0.0,
    ) -> tuple[Association, Estimate]:
        """Return the association and the estimate with the objects that can be found from few rays, and without objects of
        things that move. If the objects stay the same, both are returned as they are.

        more: as in `associate`. parameters: as in `solve`.
        """
        from objslam.association.few_rays.additional_objects import add_few_ray_objects

        placed = placed_objects(estimate)
        found = add_few_ray_objects(self._posed(more), self.settings, association, placed, seed=self.settings.seed)
        if found.count > association.count:
            association, estimate = found, self.solve(found, trace, parameters)
        if self.settings.association.method == "by_label":
            return association, estimate
        given = self.seen, self.rays_seen, association, estimate, self.seen.map_T_camera
        left = things_at_rest(*given, self.settings)
        return (association, estimate) if left is association else (left, self.solve(left, trace, parameters))

    def without_things_along_the_view(self, association: Association, estimate: Estimate) -> tuple[Association, Estimate]:
        """Return the association and the estimate without objects whose ranges show that their things move along the view.

        If there is no such object, both are returned as they are. At given poses, the other objects keep their positions."""
        from objslam.mapping.moves.receding_things import things_along_the_view

        if self.settings.association.method == "by_label":
            return association, estimate
        held = self.seen, self.rays_seen, association, estimate, self.seen.map_T_camera
        along = things_along_the_view(*held, self.settings, self.cameras)
        left = without_things(association, along)
        return (association, estimate) if left is association else (left, estimate.of_objects(~along, left.object >= 0))

    def _posed(self, more: Floats | float) -> PosedRays:
        """Return all rays at the given poses. more: as in `associate`."""
        from objslam.graph.fixed_pose_triangulation import flat_noise

        sigma, place, scale = flat_noise(self.rays, self.frames, self.settings)
        noise = np.hypot(sigma, more), place, scale
        return PosedRays(self.rays, self.frames, self.cameras, self.frames.map_T_camera, *noise)

    def solve(self, association: Association, trace: Trace | None, parameters: Parameters | None = None) -> Estimate:
        """Return the estimate of the objects of an association, and record it as a round in the trace. parameters: the
        shared errors that were removed."""
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


def associate_fixed(
    at: FixedPoses, progress: Progress, trace: Trace | None
) -> tuple[FixedPoses, Association, Estimate, tuple[dict[str, int], ...]]:
    """Find the objects at given poses. If the settings allow it, also estimate the noise of the poses.

    With too narrow gates, one object becomes several, and the rays of each show hardly any noise. So the noise is first
    taken from an association with wide gates. Then association and noise alternate until the noise no longer changes. Return
    the input with this noise, the association, the estimate, and the number of objects in each round. The last is empty
    after a single round.
    """
    rounds: tuple[dict[str, int], ...] = ()
    earlier: list[tuple[float, float]] = []
    if at.noise_unknown:
        progress("association, first", 0, 0)
        wide = at.associate(_FIRST)
        solved = at.solve(wide, None)
        at = at.with_noise_of_poses(at.noise_of_poses(wide, placed_objects(solved), solved.weight))
    for number in range(MOST_ROUNDS):
        progress("association" if number == 0 else f"association, round {number + 1}", 0, 0)
        association = at.associate()
        rounds = (*rounds, {"objects": association.count})
        progress("solve", 0, 0)
        estimate = at.solve(association, trace)
        earlier.append(at.seen.pose_noise)
        found = at.noise_of_poses(association, placed_objects(estimate), estimate.weight)
        if any(_same_noise(found, before) for before in earlier):
            break
        at = at.with_noise_of_poses(found)
    association, estimate = at.completed(association, estimate, trace)
    return at, association, with_noise_of(estimate, at), rounds if len(rounds) > 1 else ()


def placed_objects(estimate: Estimate) -> Floats:
    """Return the positions (N, 3), m, of the objects. The position is NaN for an object that was not solved."""
    return np.where(estimate.solved[:, None], estimate.positions, np.nan)


def _same_noise(one: tuple[float, float], other: tuple[float, float]) -> bool:
    return all(abs(a - b) < SAME * b for a, b in zip(one, other, strict=True))


def with_noise_of(estimate: Estimate, at: FixedPoses) -> Estimate:
    """Return the estimate with the noise of the poses, if the log shows more noise than the settings say."""
    heading, place = at.seen.pose_noise
    if heading == place == 1.0:
        return estimate
    return replace(estimate, noise=NoiseFactors(heading=heading, place=place))
