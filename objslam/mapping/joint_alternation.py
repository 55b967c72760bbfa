"""Joint mode: association and solve in turns until no ray changes its object."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING, Self

import numpy as np

from objslam.association.nearest_neighbour import associate_by_label
from objslam.config import Settings
from objslam.core.arrays import Bools, Floats
from objslam.core.camera import Camera
from objslam.core.diagnostics import Ledger
from objslam.core.geometry import inverse
from objslam.core.noise import NoiseFactors
from objslam.core.trace import Trace, Why
from objslam.core.trajectory import correct_poses, turned_since
from objslam.core.types import Association, Keyframes, Rays
from objslam.frontend.shared_errors import SharedErrors
from objslam.frontend.turning_clocks import clocks_of_turns
from objslam.mapping.duplicates import merge_unseen_together
from objslam.mapping.labels import (
    angles_to_objects,
    clock_explains,
    labels_tell,
    may_be_by_label,
    noise_explains,
    shows_second_object,
    warn_of_noise,
)
from objslam.mapping.progress import Progress
from objslam.mapping.solution import rays_moved, without_errors

if TYPE_CHECKING:
    from objslam.core.estimate import Estimate
    from objslam.graph.init_unknown_correspondences import InitialEstimate

_SOLVED_XY, _SOLVED_YAW = 0.02, 0.005
"""The noise (m, rad) of solved poses that an association expects. Larger values let it tolerate larger residuals."""
_FIRST = 2.0
"""The factor on `_SOLVED_XY` and `_SOLVED_YAW` before the first solve. A larger factor tolerates larger residuals."""
_NOISIER = 1.5
"""The factor on the noise of rays or odometry, found by a solve, above which a looser odometry is tried as well.
A larger factor explores fewer logs twice."""
_CLEAR = 0.95
"""The share of agreeing rays above which a log is not explored again, whatever its noise. A larger share explores more logs
twice. In simulation, maps that show objects twice explained at most 0.93 of the rays. A good map can explain as few: a
real robot in a forest has its log explored twice for nothing."""
_LOOSE = 3.0
"""The factor on the noise of the odometry in the second exploration, if the solve found only the rays to be noisy. A larger
factor suits worse odometry, and loses more objects of good odometry."""
_VIEW = 1.0
"""The solid angle (sr) in which a stray ray may lie, about that of a camera. With a larger value, the number of agreeing
rays counts more, and their noise less."""

Guess = tuple[Association, Floats]
"""An association of the rays, and the positions (N, 3) m of its objects."""


@dataclass(frozen=True)
class JointState:
    """The present state of the rounds of a joint solve.

    frames, all_rays: all keyframes with a pose, also without rays, as measured. keyframes, rays: the keyframes that have a
    ray, and their rays, corrected by the present shared errors. errors: the shared errors of `keyframes` and `rays`. theta:
    (P,) their last values, None before the first solve. hold: whether they are known well enough to stay fixed until the
    last solve. settled: whether no ray changed its object in the last round.
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
    settled: bool = True
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
        """Solve an association. start: (K, 4, 4) map_T_camera. begin: (P,) the first shared errors, else theta."""
        from objslam.graph import batch_solver

        at = self.theta if begin is None else begin
        given = self.keyframes, self.rays, association, self.settings, self.ledger, partial(self.progress, "solve")
        return batch_solver.solve_joint(*given, start, trace, errors, at, self.hold)

    def solve(self, why: Why, association: Association, start: Floats | None = None) -> Self:
        """Return the state after the solve of an association. start: (K, 4, 4) map_T_camera."""
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
        """Return the state with one more round that found an association."""
        changed = len(self.rays) if self.association is None else rays_moved(self.association.object, found.object)
        return replace(self, rounds=(*self.rounds, {"objects": found.count, "rays_changed": changed}))

    @property
    def solved_poses(self) -> Floats:
        """(K, 4, 4) map_T_camera of the last solve."""
        assert self.estimate is not None
        return np.asarray(self.estimate.map_T_base @ self.keyframes.base_T_camera)

    def merged(self) -> Self:
        """Return the state after objects that appear twice were merged and solved again."""
        state = self
        for _ in range(self.settings.joint.max_rounds):
            assert state.association is not None
            assert state.estimate is not None
            distance = self.settings.association.duplicate_distance
            found = merge_unseen_together(state.rays, state.association, state.estimate, distance)
            if found.count == state.association.count:
                break
            state = state.counted(found).solve("merge", found, state.solved_poses)
        return state

    def alternated(self, map_T_base: Floats, guess: Guess | None, *, drifting: bool = False) -> Self:
        """Return the state after association and solve in turns. map_T_base: (K, 4, 4) the first poses.

        If an earlier association returns, a few rays could change for ever. Then the state since the earlier one counts
        whose rays are best `explained`. A few changed rays hardly change the shared errors, which take most of the time of a
        solve. So these stay as the first round found them until the rounds end, and are then estimated again. drifting:
        whether to allow for the drift of keyframes without an assigned ray.
        """
        state, earlier, held = self, dict[bytes, Self](), False  # Whether the last solve held the shared errors.
        for number in range(self.settings.joint.max_rounds):
            self.progress(f"association, round {number + 1}", 0, 0)
            found = state._associate(map_T_base, guess, drifting)
            state, key = state.counted(found), found.object.tobytes()
            same = state.rounds[-1]["rays_changed"] == 0
            if same or key in earlier:
                if not same and (state.errors is None or state.hold):
                    returned = list(earlier).index(key)
                    state = state.continued_from(max(list(earlier.values())[returned:], key=lambda one: one.explained))
                if not held:
                    return replace(state, hold=self.hold, settled=True)
                state, held = state.released(self.hold), False
            else:
                solved = state.solve("association", found, map_T_base @ state.keyframes.base_T_camera)
                solved = replace(solved, hold=state.errors is not None)
                before, state = state.hold, solved.merged()
                held = solved.hold != self.hold and (before or state is not solved)
                earlier[key] = state
            assert state.association is not None
            assert state.estimate is not None
            map_T_base, guess = state.estimate.map_T_base, (state.association, state.estimate.positions)
        return replace(state.released(self.hold) if held else state, hold=self.hold, settled=False)

    def released(self, hold: bool) -> Self:
        """Return the state after one more solve, which estimates the shared errors again unless they are to `hold`."""
        assert self.association is not None
        state = replace(self, hold=hold)
        return state.solve("association", self.association, self.solved_poses).merged()

    def continued_from(self, chosen: Self) -> Self:
        """Return a state of an earlier round, settled, with the rounds until now."""
        if self.trace is not None and chosen.estimate is not self.estimate:
            assert chosen.association is not None
            assert chosen.estimate is not None
            self.trace.end_round("association", chosen.association, chosen.estimate)
        return replace(chosen, rounds=self.rounds, settled=True)

    def drift_followed(self) -> Self:
        """Return the state after rounds that allow for the drift of keyframes without an assigned ray, if it is `better`.

        These keyframes follow the odometry alone. If it has drifted by more than the noise of a ray, no association at their
        poses finds their objects. Wider gates can also lose objects, so `better` decides.
        """
        assert self.association is not None
        assert self.estimate is not None
        drift = turned_since(self.keyframes, self.rays.keyframe[self.association.object >= 0])[self.rays.keyframe]
        if not (drift > self.rays.sigma).any():
            return self
        guess = self.association, self.estimate.positions
        return self.better(self.attempt().alternated(self.estimate.map_T_base, guess, drifting=True))

    def attempt(self) -> Self:
        """Return a state for rounds that may be discarded."""
        return replace(self, ledger=Ledger(), trace=None if self.trace is None else self.trace.aside())

    def better(self, attempt: Self) -> Self:
        """Return the result of an attempt if its rays are better `explained` than those of this state, else this state."""
        if attempt.explained <= self.explained:
            return self
        self.ledger.add(attempt.ledger)
        if self.trace is not None and attempt.trace is not None:
            self.trace.rounds.extend(attempt.trace.rounds)
        return replace(attempt, ledger=self.ledger, trace=self.trace)

    @property
    def agree(self) -> Bools:
        """(R,) whether a ray agrees with its object."""
        assert self.association is not None
        assert self.estimate is not None
        return np.asarray((self.estimate.weight > 0) & (self.association.object >= 0))

    @property
    def explained(self) -> float:
        """The sum over agreeing rays of the log odds that a ray belongs to its object and is not false.

        Each object costs as much as `association.min_rays` average rays give. The density is 1 / (2 pi e sigma^2) per sr for
        an agreeing ray, on average, and 1 / `_VIEW` for a false one. If more rays agree only because their noise was
        estimated larger, each of them counts less. A ray with more noise than a view counts 0.
        """
        assert self.association is not None
        gain = np.maximum(np.log(_VIEW / (2 * np.pi * np.e * self.rays.sigma**2)), 0.0)
        return float(gain[self.agree].sum() - self.settings.association.min_rays * self.association.count * gain.mean())

    def _associate(self, map_T_base: Floats, guess: Guess | None, drifting: bool) -> Association:
        from objslam.association.global_association import associate_globally

        frames, rays = self.frames, self.all_rays
        if self.errors is not None and self.theta is not None:
            frames, rays, _ = self.errors.take(frames, rays).at(self.theta, drift=False)
            # If the estimated noise is below the nominal noise, it describes inliers only. The gate needs the larger one.
            rays = replace(rays, sigma=np.maximum(rays.sigma, self.all_rays.sigma))
        mine = self.keyframes
        at = correct_poses(frames.stamps, frames.map_T_base, mine.stamps, mine.map_T_base, map_T_base)
        scale = 1.0 if self.rounds else _FIRST
        sigma = np.hypot(rays.sigma, scale * _SOLVED_YAW)
        if drifting and guess is not None:
            since = turned_since(mine, self.rays.keyframe[guess[0].object >= 0])
            sigma = np.hypot(sigma, since[self.rays.keyframe])
        return associate_globally(
            rays,
            frames,
            self.cameras,
            self.settings,
            map_T_camera=at @ frames.base_T_camera,
            sigma=sigma,
            position_sigma=scale * _SOLVED_XY,
            seed=self.settings.seed,
            guess=guess,
        )


def solve_joint(
    state: JointState, start: InitialEstimate | None
) -> tuple[Association, Estimate, tuple[dict[str, int], ...]]:
    """Associate and solve a log, and return the association, the estimate, and the counts of each round.

    start: a known start. With it, the log is not explored, and labels are not trusted.
    """
    state = _with_clocks(state)
    if start is None and may_be_by_label(state.settings, state.all_rays):
        state, agree = _by_label(state)
        if agree and state.settings.association.method == "auto":
            state, agree = _with_doubles(state)
        if agree:
            assert state.association is not None
            assert state.estimate is not None
            return state.association, state.estimate, ()
        state = replace(state, association=None, estimate=None)
    if start is not None or state.keyframes.localized_every:
        state = _from_start(state, start).drift_followed()
    else:
        state = _from_start(*_explored(state)).drift_followed()
        noisier = _with_loose_odometry(state)
        if noisier is not None:
            state = state.better(_from_start(*_explored(noisier)).drift_followed())
    if not state.settled:
        rounds = state.settings.joint.max_rounds
        state.ledger.warn(f"the association still changes after {rounds} rounds (joint.max_rounds)")
    assert state.association is not None
    if state.hold:  # The covariances now contain the shared errors, so that more pairs may be one object.
        state = replace(state, hold=False).solve("association", state.association, state.solved_poses).merged()
    assert state.association is not None
    assert state.estimate is not None
    return state.association, state.estimate, state.rounds


def _with_clocks(state: JointState) -> JointState:
    """Return the state that begins at the clocks which the robot's turns show."""
    if state.errors is None or state.theta is not None:
        return state
    theta = clocks_of_turns(state.errors)
    keyframes, rays, _ = state.errors.at(theta)
    return replace(state, theta=theta, keyframes=keyframes, rays=rays)


def _from_start(state: JointState, start: InitialEstimate | None) -> JointState:
    """Return the state after rounds from a start, or from the poses of the keyframes."""
    map_T_camera = state.keyframes.map_T_camera if start is None else start.map_T_camera
    guess = None if start is None else (start.association, start.positions)
    return state.alternated(map_T_camera @ inverse(state.keyframes.base_T_camera), guess)


def _by_label(state: JointState) -> tuple[JointState, bool]:
    """Return the state with one object per label, and whether the rays agree with it. If they disagree at a few labels only,
    the shared errors and the noise of the state are still better than the nominal values."""
    association, errors = associate_by_label(state.rays), state.errors
    solved = state.solve("labels", association)
    assert solved.estimate is not None
    if state.settings.association.method == "by_label" or labels_tell(association, solved.estimate):
        return solved, True
    if solved.errors is None or errors is None:
        return solved, False
    noisier = noise_explains(association, solved.estimate, solved.errors, partial(solved.solve_once, association))
    if noisier is not None:
        warn_of_noise(solved.errors, noisier, state.ledger)
        return solved.solve("labels", association, noisier.map_T_base @ solved.keyframes.base_T_camera), True
    begin = clock_explains(association, errors, lambda at: solved.solve_once(association, errors, begin=at))
    if begin is None:
        return solved, False
    return replace(solved, errors=errors, theta=begin).solve("labels", association), True


def _with_doubles(state: JointState) -> tuple[JointState, bool]:
    """Return the state of one object per label with the nearest box of each label and keyframe, and whether the other boxes
    show no second object of any label."""
    assert state.association is not None
    assert state.estimate is not None
    if (state.association.object >= 0).all():
        return state, True
    nearest = associate_by_label(state.rays, angles_to_objects(state.rays, state.estimate, state.solved_poses))
    if not np.array_equal(nearest.object, state.association.object):
        state = state.solve("labels", nearest, state.solved_poses)
    assert state.estimate is not None
    solved = state.rays, nearest, state.estimate, state.keyframes, state.solved_poses
    return state, not shows_second_object(*solved, state.settings)


def _explored(state: JointState) -> tuple[JointState, InitialEstimate]:
    """Explore a log without a localisation. Return the state and a first association. If the filter for logs with ranges is
    sure of the association, the state is solved with it and holds the shared errors."""
    from objslam.graph import ekf_exploration
    from objslam.graph.init_unknown_correspondences import initialize_unknown

    exploring = partial(state.progress, "explore")
    start: InitialEstimate | None = None
    if np.isfinite(state.rays.range).any():
        start = ekf_exploration.explore(state.keyframes, state.rays, state.settings, exploring, state.errors)
    if start is None or not ekf_exploration.is_sure(start):
        return state, initialize_unknown(state.keyframes, state.rays, state.cameras, state.settings, exploring)
    solved = state.solve("association", start.association)
    assert solved.estimate is not None
    start = replace(start, map_T_camera=solved.solved_poses, positions=solved.estimate.positions)
    return replace(solved, hold=True, association=None), start


def _with_loose_odometry(state: JointState) -> JointState | None:
    """Return an attempt with the noise of the odometry that the last solve suggests.

    None if this noise is about nominal, if the settings fix it, or if nearly all rays agree. The solve finds this noise, but
    the exploration needs it before. A wrong map can hide it in the noise of the rays.
    """
    if state.errors is None or "odometry" not in state.errors.unknown_noise or state.agree.mean() >= _CLEAR:
        return None
    found, values = state.errors.noise, state.theta
    if max(found.along, found.turning) <= _NOISIER:
        if found.rays <= _NOISIER:
            return None
        found, values = NoiseFactors(along=_LOOSE, across=_LOOSE, turning=_LOOSE), None
    errors = state.errors.with_noise(replace(found, shrinkage=0.0))
    keyframes, rays, _ = errors.at(errors.mean if values is None else values)
    unknown = replace(state.attempt(), association=None, estimate=None, hold=False, theta=values)
    return replace(unknown, errors=errors, keyframes=keyframes, rays=rays)
