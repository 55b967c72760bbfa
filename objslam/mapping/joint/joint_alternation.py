"""Joint mode: association and solve in turns until no ray changes its object."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import TYPE_CHECKING, Self

import numpy as np

from objslam.config import Settings
from objslam.core.arrays import Bools, Floats
from objslam.core.camera import Camera
from objslam.core.diagnostics import Ledger
from objslam.core.ground.flattening import LEVEL, flat_scale
from objslam.core.trace import Trace, Why
from objslam.core.trajectory import correct_poses
from objslam.core.types import Association, Keyframes, Rays
from objslam.frontend.shared_errors import SharedErrors
from objslam.mapping.joint.merge_and_split import merge_unseen_together, split_at_gaps
from objslam.mapping.joint.names import beside_names
from objslam.mapping.progress import Progress
from objslam.mapping.solution import Solution, objects_changed, rays_moved, without_errors

if TYPE_CHECKING:
    from objslam.core.estimate import Estimate

_SOLVED_XY, _SOLVED_YAW = 0.02, 0.005
"""The noise (m, rad) of solved poses that an association expects. With larger values, it tolerates larger residuals."""
_FIRST = 2.0
"""The factor on `_SOLVED_XY` and `_SOLVED_YAW` before the first solve, and on a path from a grid. With a larger factor, an
association tolerates larger residuals."""
_RUINED = 200.0
"""The best round replaces the last round if its log odds over the last round are at least this value. A right merge may at
first cost 80, and ruined maps cost 500 to 5000. With a larger value, a worse map may stay."""
Guess = tuple[Association, Floats]
"""An association of the rays, and the positions (N, 3) m of its objects."""


@dataclass
class Effort:
    """The solves that a search has taken, and whether the user interrupted it. All attempts of a search share one object."""

    solves: int = 0
    interrupted: bool = False


@dataclass(frozen=True)
class JointState:
    """The present state of the rounds of a joint solve.

    frames, all_rays: all keyframes with a pose and all rays, as measured. keyframes, rays: the keyframes that have a ray,
    and their rays, corrected by the present shared errors. errors: the shared errors of `keyframes` and `rays`. theta: (P,)
    their last values, None before the first solve. hold: whether the shared errors stay fixed until the last solve, because
    they are known well enough. unsettled, unfinished: as in `Solution`. effort: the effort of the search that this state
    belongs to. doubted: the labels that may name one object or several. names: the objects of labels that are known to be
    names. The rounds of association do not change the rays of such objects. at_poses: the association of a map at the given
    poses, if any.
    """

    frames: Keyframes
    all_rays: Rays
    keyframes: Keyframes
    rays: Rays
    cameras: tuple[Camera, ...]
    settings: Settings
    ledger: Ledger
    progress: Progress
    trace: Trace | None
    errors: SharedErrors | None
    theta: Floats | None = None
    hold: bool = False
    unsettled: int = 0
    unfinished: bool = False
    effort: Effort = field(default_factory=Effort)
    doubted: tuple[str, ...] = ()
    names: Association | None = None
    at_poses: Association | None = None
    rounds: tuple[dict[str, int], ...] = ()
    association: Association | None = None
    estimate: Estimate | None = None

    def solve_once(
        self,
        association: Association,
        errors: SharedErrors | None,
        start: Floats | None = None,
        trace: Trace | None = None,
        begin: Floats | None = None,
    ) -> Estimate:
        """Solve an association. start: (K, 4, 4) first map_T_camera. begin: (P,) first shared errors, None for theta."""
        from objslam.graph import batch_solver

        self.effort.solves += 1
        at = self.theta if begin is None else begin
        given = self.keyframes, self.rays, association, self.settings, self.ledger, partial(self.progress, "solve")
        return batch_solver.solve_joint(*given, start, trace, errors, at, self.hold)

    def solve(self, why: Why, association: Association, start: Floats | None = None) -> Self:
        """Return the state after the solve of an association. start: (K, 4, 4) first map_T_camera."""
        solved = self.solve_once(association, self.errors, start, self.trace)
        if self.trace is not None:
            self.trace.end_round(why, association, solved)
        state = replace(self, association=association, estimate=solved)
        if self.errors is None or solved.noise is None:
            return state
        errors = self.errors.with_noise(solved.noise)
        theta = errors.mean if solved.calibration is None else solved.calibration.values
        keyframes, rays = without_errors(errors, solved)
        return replace(state, errors=errors, theta=theta, keyframes=keyframes, rays=rays)

    def counted(self, found: Association) -> Self:
        """Return the state after one more round, which found the association `found`."""
        changed = len(self.rays) if self.association is None else rays_moved(self.association.object, found.object)
        return replace(self, rounds=(*self.rounds, {"objects": found.count, "rays_changed": changed}))

    @property
    def solved_poses(self) -> Floats:
        """(K, 4, 4) map_T_camera of the last solve."""
        assert self.estimate is not None
        return np.asarray(self.estimate.map_T_base @ self.keyframes.base_T_camera)

    @property
    def spent(self) -> bool:
        """Whether the search has taken all the solves that it may take, or the user interrupted it."""
        return self.effort.interrupted or self.effort.solves >= self.settings.joint.max_solves

    def merged(self, bundles: bool = False) -> Self:
        """Return the state after objects that appear twice were merged and solved again.

        bundles: whether two objects may be bundles of rays to one thing from different sides. The boxes of each side have a
        different error (`box_offsets`), so such bundles lie farther apart than their covariances say.
        """
        state = self
        for _ in range(self.settings.joint.max_rounds):
            assert state.association is not None
            assert state.estimate is not None
            distance = self.settings.association.duplicate_distance
            estimate = state._with_box_offsets() if bundles else state.estimate
            found = merge_unseen_together(state.rays, state.association, estimate, distance)
            if found.count == state.association.count:
                break
            state = state.counted(found).solve("merge", found, state.solved_poses)
        return state

    def alternated(self, map_T_base: Floats, guess: Guess | None) -> Self:
        """Return the state after association and solve in turns. map_T_base: (K, 4, 4) the first poses.

        If a round finds the association of an earlier round again, a few rays could change back and forth without end. Then
        the best `explained` state since that round is returned. A few changed rays hardly change the shared errors, but
        estimating the shared errors takes most of the time of a solve. So they keep the values of the first round. After the
        last round, they are estimated again.
        """
        state, before, earlier, states = self, self, dict[bytes, Self](), [] if self.estimate is None else [self]
        held = False  # Whether the last solve held the shared errors.
        for number in range(self.settings.joint.max_rounds):
            self.progress(f"association, round {number + 1}, after {self.effort.solves} solves", 0, 0)
            found = state.associated(map_T_base, guess, rough=not state.rounds)
            state, key = state.counted(found), found.object.tobytes()
            same = state.rounds[-1]["rays_changed"] == 0
            if same or key in earlier:
                if not same and (state.errors is None or state.hold):
                    returned = list(earlier).index(key)
                    state = state.continued_from(max(list(earlier.values())[returned:], key=lambda one: one.explained))
                if not held:
                    return replace(state, hold=self.hold, unsettled=0)._or_if_ruined(states)
                before = state = state.released(self.hold)
                held = False
            else:
                before, holds = state, state.hold
                solved = state.solve("association", found, map_T_base @ state.keyframes.base_T_camera)
                solved = replace(solved, hold=state.errors is not None)
                state = solved.merged()
                states += [solved, state]
                held = solved.hold != self.hold and (holds or state is not solved)
                earlier[key] = state
            assert state.association is not None
            assert state.estimate is not None
            map_T_base, guess = state.estimate.map_T_base, (state.association, state.estimate.positions)
        unsettled = state.changed_since(before)
        state = state.released(self.hold) if held else state
        return replace(state, hold=self.hold, unsettled=unsettled)._or_if_ruined(states)

    def _or_if_ruined(self, states: Sequence[Self]) -> Self:
        """Return this state, or the best of some earlier states if it explains the log far better (`_RUINED`).

        In the last round, a map can be ruined by a wrong merge, or by noise that is estimated from half of the rays."""
        best = max(states, key=lambda one: one.explained, default=self)
        if best.association is None or best.explained - self.explained < _RUINED:
            return self
        again = replace(best.attempt(), hold=self.hold).solve("association", best.association, best.solved_poses)
        return replace(self.replaced(again), rounds=self.rounds, unsettled=0) if again.explained > self.explained else self

    def changed_since(self, before: Self) -> int:
        """Return the number of objects that differ from an earlier state (`objects_changed`)."""
        if before is self:
            return 0
        assert self.association is not None
        assert self.estimate is not None
        if before.association is None or before.estimate is None:
            return self.association.count
        return objects_changed((before.association, before.estimate), (self.association, self.estimate))

    def released(self, hold: bool) -> Self:
        """Return the state after one more solve. hold: whether the solve keeps the shared errors. If not, it estimates
        them."""
        assert self.association is not None
        state = replace(self, hold=hold)
        return state.solve("association", self.association, self.solved_poses).merged()

    def continued_from(self, chosen: Self) -> Self:
        """Return the state of an earlier round as settled, with the counts of all rounds until now."""
        if self.trace is not None and chosen.estimate is not self.estimate:
            assert chosen.association is not None
            assert chosen.estimate is not None
            self.trace.end_round("association", chosen.association, chosen.estimate)
        return replace(chosen, rounds=self.rounds, unsettled=0)

    def split(self) -> Self:
        """Return the state after splits of the objects that may be two things, if it is `better`. Otherwise return this
        state.

        The rounds of `alternated` do not separate two things that share one object, because the path is bent until all rays
        agree. They also keep a phantom where the rays of two things cross. So this method splits all objects whose rays come
        in two bundles at once. A solve takes the bend out of the path. Then bundles of one thing are merged again.
        """
        assert self.association is not None
        _, direction = self.rays.in_map(self.solved_poses)
        found = split_at_gaps(direction, self.association, self.agree, self.settings.association.min_rays)
        if found.count == self.association.count:
            return self
        # Bundles of one thing usually merge again if the shared errors are held, which takes half the time.
        for hold in dict.fromkeys((True, self.hold)):
            attempt = replace(self.attempt(), hold=hold).counted(found).solve("split", found, self.solved_poses)
            attempt = attempt.merged(bundles=True)
            if self._has_rays_of(attempt):
                return self
        assert attempt.association is not None
        assert attempt.estimate is not None
        attempt = attempt.alternated(attempt.estimate.map_T_base, (attempt.association, attempt.estimate.positions))
        return self if self._has_rays_of(attempt) else self.better(attempt)

    def _with_box_offsets(self) -> Estimate:
        """Return the estimate with the errors that boxes share added to its covariances. Their size is that of the settings,
        because rays from one side do not show it."""
        from objslam.mapping.box_offsets import with_box_offsets

        assert self.association is not None
        assert self.estimate is not None
        noise = self.settings.noise.model_copy(update={"rays": False})
        solution = Solution(self.keyframes, self.rays, self.association, self.estimate, ())
        return with_box_offsets(solution, self.cameras, self.settings.model_copy(update={"noise": noise})).estimate

    def _has_rays_of(self, other: Self) -> bool:
        """Return whether the objects have the same rays as in another state."""
        assert self.association is not None
        assert other.association is not None
        return rays_moved(self.association.object, other.association.object) == 0

    def attempt(self) -> Self:
        """Return a state for rounds that may be discarded."""
        return replace(self, ledger=Ledger(), trace=None if self.trace is None else self.trace.aside())

    def better(self, attempt: Self) -> Self:
        """Return the result of an attempt if its association explains more than that of this state. Otherwise return this
        state."""
        return self.replaced(attempt) if self.gain(attempt) > 0 else self

    def gain(self, attempt: Self) -> float:
        """Return the log odds of the association of an attempt over the association of this state.

        Each association is judged at the errors and the noise of both states, and the larger value counts. The noise that a
        wrong map estimates may be far from the noise at which it explains most. The sum of the gains at both states would
        favour an attempt with much noise. At such noise, a good map explains little more than a bad map.
        """
        mine = max(self.explained, self._explained_like(attempt))
        return max(attempt.explained, attempt._explained_like(self)) - mine

    def replaced(self, attempt: Self) -> Self:
        """Return the result of an attempt, with the ledger and the trace of this state."""
        self.ledger.add(attempt.ledger)
        if self.trace is not None and attempt.trace is not None:
            self.trace.rounds.extend(attempt.trace.rounds)
        return replace(attempt, ledger=self.ledger, trace=self.trace)

    def _explained_like(self, other: Self) -> float:
        """Return `explained` of this association at the shared errors and the noise of another state."""
        if self.errors is None or other.errors is None or other.theta is None:
            return self.explained
        assert self.association is not None
        keyframes, rays, _ = other.errors.at(other.theta)
        there = replace(self.attempt(), keyframes=keyframes, rays=rays, theta=other.theta, hold=True)
        return there.solve_once(self.association, other.errors, self.solved_poses).log_evidence

    @property
    def agree(self) -> Bools:
        """A mask (R,) of the rays that agree with their object."""
        assert self.association is not None
        assert self.estimate is not None
        return np.asarray((self.estimate.weight > 0) & (self.association.object >= 0))

    @property
    def explained(self) -> float:
        """The log evidence for the association: how well it explains both the rays and the odometry."""
        assert self.estimate is not None
        return self.estimate.log_evidence

    def every_frame(self, map_T_base: Floats) -> tuple[Keyframes, Rays, Floats]:
        """Return all F keyframes with a pose, all rays, and map_T_camera (F, 4, 4) of the keyframes.

        Keyframes and rays are corrected by the present shared errors. map_T_base: (K, 4, 4) of the keyframes that have a
        ray."""
        frames, rays = self.frames, self.all_rays
        if self.errors is not None and self.theta is not None:
            frames, rays, _ = self.errors.take(frames, rays).at(self.theta, drift=False)
            # Estimated noise below the nominal noise describes inliers only. The gate needs the nominal noise then.
            rays = replace(rays, sigma=np.maximum(rays.sigma, self.all_rays.sigma))
        mine = self.keyframes
        at = correct_poses(frames.stamps, frames.map_T_base, mine.stamps, mine.map_T_base, map_T_base)
        return frames, rays, at @ frames.base_T_camera

    def associated(self, map_T_base: Floats, guess: Guess | None, *, rough: bool) -> Association:
        """Return an association of the rays at poses map_T_base (K, 4, 4). guess: where the search begins. rough: whether
        the poses are not from a solve, so that residuals are larger."""
        from objslam.association.global_association import associate_globally
        from objslam.association.observations import PosedRays
        from objslam.graph.fixed_pose_triangulation import noise_of_poses, noise_up

        frames, rays, map_T_camera = self.every_frame(map_T_base)
        mine = self.keyframes
        scale = _FIRST if rough else 1.0
        yaw, place = scale * _SOLVED_YAW, scale * _SOLVED_XY
        if rough and mine.localized_every:  # The poses are those of the localisation.
            yaw, place = (max(pair) for pair in zip((yaw, place), noise_of_poses(mine, self.settings), strict=True))
        sigma, flat = np.hypot(rays.sigma, yaw), LEVEL
        if rough and mine.localized_every:  # A solve corrects tilt and height of the poses. Before it, rays have both.
            flat = flat_scale(rays, (yaw, place), self.settings) if any(noise_up(mine, self.settings)) else LEVEL
        if not rough:  # A solve has shown how large the error is that all ranges of an object share.
            rays = replace(rays, range_sigma=np.hypot(rays.range_sigma, np.nan_to_num(rays.range_bias)))
        found = associate_globally(
            PosedRays(rays, frames, self.cameras, map_T_camera, sigma, place, flat),
            self.settings,
            seed=self.settings.seed,
            guess=guess,
            # After a solve, landmarks hold the path together. Before the first solve, only the odometry does so.
            drifts=rough and frames.odom_T_base is not None and not frames.localized_every,
            solved=not rough,
        )
        return found if self.names is None else beside_names(self.names, found, rays)
