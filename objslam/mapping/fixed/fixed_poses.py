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
"""The most rounds of association and calibration. Two or three are usual. A clock that is off by a second moves by 0.03 s in
a round, so it reaches its bound after ten rounds. A larger number is slower for logs that do not settle."""
SAME = 0.05
"""An association is repeated only if ray directions or their noise are new: they differ from each earlier round by more than
this share of the noise. A smaller change moves hardly any ray across a gate, and a cycle of rounds repeats itself. A larger
share ends sooner. A limit in standard deviations of the shared errors does not work: with precise errors, the association
can swing between two states for ever."""
_FIRST = 0.05
"""The noise (rad) of ray directions that is added to the noise in the settings, for the association from which the noise of
the poses is taken. The priors of the shared errors of a camera allow errors of about this size. With a larger value, near
objects become one, and then their rays show nothing of the poses."""


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

        positions: (N, 3) m, NaN for an object without a position. weight: (R,) 0 for a rejected ray. A rejected ray does not
        count."""
        if not self.noise_unknown:
            return 1.0, 1.0
        agreeing = replace(association, object=np.where(weight > 0, association.object, -1))
        return noise_in_frames(self.seen, self.rays_seen, agreeing, positions, self.settings)

    def associate(self, more: Floats | float = 0.0, guess: tuple[Association, Floats] | None = None) -> Association:
        """Associate the rays. more: (R,) rad, noise of the ray directions in addition to the noise of boxes and poses.

        guess: an association at nearly these poses, and the positions (N, 3) m of its objects. The association begins there.
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
        things that move. Both stay the same if nothing changes.

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
        """Return the association and the estimate without objects of things that move along the view, as their ranges show.

        Both stay the same if there are none. At given poses, the other objects stay where they are."""
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


def associate_fixed(
    at: FixedPoses, progress: Progress, trace: Trace | None
) -> tuple[FixedPoses, Association, Estimate, tuple[dict[str, int], ...]]:
    """Find the objects, and the noise of the poses if the settings allow it.

    With too narrow gates, one object becomes several, and their rays show hardly any noise. So the noise is first taken from
    an association with wide gates. Then the association and the noise are found in turns until the noise no longer changes.
    Returns the input with this noise, the association, the estimate, and the number of objects in each round if there were
    several.
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
    """Return the positions (N, 3), m, NaN for an object without one."""
    return np.where(estimate.solved[:, None], estimate.positions, np.nan)


def _same_noise(one: tuple[float, float], other: tuple[float, float]) -> bool:
    return all(abs(a - b) < SAME * b for a, b in zip(one, other, strict=True))


def with_noise_of(estimate: Estimate, at: FixedPoses) -> Estimate:
    """Return an estimate that names the noise of the poses, if the log shows more than the settings say."""
    heading, place = at.seen.pose_noise
    if heading == place == 1.0:
        return estimate
    return replace(estimate, noise=NoiseFactors(heading=heading, place=place))
