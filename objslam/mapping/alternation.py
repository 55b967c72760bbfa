"""Find and solve the objects of a log, in fixed or in joint mode."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

from objslam.config import Settings
from objslam.core.camera import Camera
from objslam.core.diagnostics import Ledger
from objslam.core.trace import Trace
from objslam.core.types import Association, Keyframes, Rays
from objslam.errors import SolveError
from objslam.frontend.shared_errors import SharedErrors
from objslam.mapping.checks.unexplained import warn_of_unexplained
from objslam.mapping.fixed.camera_calibration import calibrate_fixed
from objslam.mapping.fixed.fixed_poses import FixedPoses, associate_fixed
from objslam.mapping.fixed.map_at_poses import MapAtPoses
from objslam.mapping.progress import Progress
from objslam.mapping.solution import Solution, seen_something, without_errors

if TYPE_CHECKING:
    from objslam.graph.init_unknown_correspondences import InitialEstimate


def solve(
    frames: Keyframes,
    rays: Rays,
    cameras: tuple[Camera, ...],
    settings: Settings,
    ledger: Ledger,
    progress: Progress,
    start: InitialEstimate | None = None,
    errors: SharedErrors | None = None,
    earlier: MapAtPoses | None = None,
) -> Solution:
    """Find and solve the objects of a log.

    In fixed mode, the association runs once, at the given poses. If cameras are calibrated against these poses, it runs
    several times. In joint mode, the poses are explored first, unless the log has a localisation. Then association and solve
    alternate until no ray changes its object. At the end, the bearings may be turned to the centres of bodies. If the
    settings ask for it, each label is one object, and no ray is associated. The joint mode also tries one object for each
    label if hardly any frame has two boxes of one label. It keeps this map if its rays agree.

    frames: all keyframes with a pose, with and without rays. start: a known start for the keyframes with rays. With a start,
    the joint mode does not explore, and does not take labels for names. errors: the shared errors of the keyframes with
    rays. The solve estimates them and removes them from the keyframes and rays. earlier: a map of the same log at its given
    poses. SolveError if the joint mode has neither odometry nor localisation.
    """
    keyframes, rays_of_keyframes = seen_something(frames, rays)
    trace = Trace(keyframes.base_T_camera) if settings.output.recording else None
    doubted: tuple[str, ...] = ()
    unsettled = copied = 0
    unfinished = False
    whole: Association | None = None
    estimated = errors
    if settings.mode == "fixed":
        at = FixedPoses(frames, rays, keyframes, rays_of_keyframes, cameras, settings)
        if errors is None:
            at, association, estimate, rounds = associate_fixed(at, progress, trace)
        else:
            at, association, estimate, rounds = calibrate_fixed(at, errors, ledger, progress, trace)
        keyframes, rays_of_keyframes, whole = at.seen, at.rays_seen, association
        association, estimate = at.without_things_along_the_view(association, estimate)
    elif not frames.localized_every and frames.odom_T_base is None:
        raise SolveError("the joint mode needs odometry or localisation", hint="give one of them, or use --mode fixed")
    else:  # The fixed mode does without these modules, and the many below them.
        from objslam.mapping.bodies.centre_bearings import solve_to_centres
        from objslam.mapping.joint.joint_alternation import JointState
        from objslam.mapping.joint_solve import solve_joint
        from objslam.mapping.moves.missed_loops import largest_copy_in

        begin = JointState(frames, rays, keyframes, rays_of_keyframes, cameras, settings, ledger, progress, trace, errors)
        if earlier is not None:
            begin = replace(begin, at_poses=earlier.association_of(rays_of_keyframes))
        state = solve_joint(begin, start)
        if errors is not None and state.errors is not None and state.errors.names != errors.names:
            estimated = errors = state.errors.with_noise(errors.noise)
            begin = replace(begin, errors=errors, settings=errors.settings)
        assert state.association is not None
        assert state.estimate is not None
        association, estimate, rounds = state.association, state.estimate, state.rounds
        doubted, unsettled, unfinished = state.doubted, state.unsettled, state.unfinished
        copied = 0 if keyframes.localized_every else largest_copy_in(state)
        estimate, added = solve_to_centres(begin, association, estimate)
        if added is not None and added.ranges is not None:
            rays_of_keyframes = added.ranges.apply(rays_of_keyframes, settings)
            errors = None if errors is None else replace(errors, rays=added.ranges.apply(errors.rays, settings))
        if errors is not None:
            keyframes, rays_of_keyframes = without_errors(errors, estimate)
        if added is not None:
            rays_of_keyframes = added.apply(rays_of_keyframes)
    warn_of_unexplained(rays_of_keyframes, association, ledger)
    recorded = tuple(trace.rounds if trace else ())
    solved = Solution(keyframes, rays_of_keyframes, association, estimate, rounds, recorded)
    judged = replace(solved, doubted=doubted, unsettled=unsettled, unfinished=unfinished, copied=copied)
    return replace(judged, errors=estimated, whole=whole)
