"""Find the shared errors of a log before there is a map. Each track of boxes serves as a landmark."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from objslam.core.geometry import inverse
from objslam.core.trajectory import correct_poses
from objslam.errors import SolveError
from objslam.frontend.tracks import associate_tracks

if TYPE_CHECKING:
    from objslam.core.arrays import Bools, Floats, Ints
    from objslam.mapping.joint.joint_alternation import JointState

_ROUNDS = 2
"""The number of rounds in which tracks are found and solved. The second round finds tracks with the odometry that the first
round corrected. More rounds change the errors by less than their sigmas."""
_APART = 0.15
"""The length (s) of the spans of time from which one image of each camera is solved. These images are enough to link a
track, and more images would add little. With a larger time, the solve of a video is faster, but tracks are lost while the
robot turns fast."""
_MOST = 3000
"""About the largest number of rays that are solved. With a larger number, the errors are more exact than an exploration
needs, and the solve takes longer."""
_BLOCK = 50
"""The number of consecutive keyframes in a block. If there are more than `_MOST` rays, blocks at even intervals are solved,
and the others are left out. A track ends where its block ends. With a larger number, fewer tracks are cut, but fewer parts
of the drive count."""


def with_errors_of_tracks(state: JointState) -> tuple[JointState, Floats]:
    """Return the state that begins at the shared errors which the tracks of boxes show.

    Also return the poses (K, 4, 4) map_T_base of the path that the tracks correct. If wheels slip, the robot turns within a
    track, so the track shows the slip.

    A track is a chain of boxes in images that follow each other (`frontend.tracks`). Nobody needs to know which tracks show
    the same thing. At the right clocks, turns and rotations of cameras, the rays of each track meet in one point. So the
    tracks are solved as landmarks, with the odometry and the priors of all errors. If the log has ranges, the noise is not
    estimated. Short tracks hardly show the noise of distances. In simulated videos, the estimate was twenty times too large.

    The first association of a drive takes these errors as given. With a gyroscope that turns by 0.2 degrees a second too
    much, the rays of one minute meet nowhere.
    """
    if state.errors is None or not state.errors.names or state.keyframes.odom_T_base is None:
        return state, state.keyframes.map_T_base
    tracked = _excerpt(state)
    for _ in range(_ROUNDS):
        association = associate_tracks(tracked.keyframes, tracked.rays)
        if association.count == 0:
            break
        try:
            tracked = tracked.solve("association", association)
        except SolveError:  # No track tells anything.
            break
    if tracked.estimate is None or tracked.theta is None:
        return state, state.keyframes.map_T_base
    keyframes, rays, _ = state.errors.at(tracked.theta)
    at, solved = tracked.keyframes, tracked.estimate.map_T_base
    path = correct_poses(keyframes.stamps, keyframes.map_T_base, at.stamps, at.map_T_base, solved)
    return replace(state, theta=tracked.theta, keyframes=keyframes, rays=rays), path


def along(state: JointState, path: Floats) -> JointState:
    """Return the state whose odometry is a path (K, 4, 4). It is for an exploration only, because a solve would count the
    tracks twice."""
    assert state.keyframes.odom_T_base is not None
    odom_T_base = state.keyframes.odom_T_base[0] @ inverse(path[0]) @ path
    return replace(state, keyframes=replace(state.keyframes, map_T_base=path, odom_T_base=odom_T_base))


def _excerpt(state: JointState) -> JointState:
    """Return an attempt with images that are about `_APART` apart. If these have more than `_MOST` rays, only some blocks of
    consecutive keyframes stay. If there are ranges, the attempt does not estimate the noise."""
    assert state.errors is not None
    keep = _apart(state.keyframes.stamps, state.keyframes.camera)
    every = -(-int(keep[state.rays.keyframe].sum()) // _MOST)
    keep &= (np.cumsum(keep) - 1) // _BLOCK % every == 0
    number, mine = np.cumsum(keep) - 1, keep[state.rays.keyframe]
    measured = []
    for keyframes, rays in ((state.keyframes, state.rays), (state.errors.keyframes, state.errors.rays)):
        some = rays.take(mine)
        measured.append((keyframes.take(keep), replace(some, keyframe=number[some.keyframe])))
    (keyframes, rays), raw = measured
    settings = state.settings
    if np.isfinite(rays.range).any():
        noise = settings.noise.model_copy(update={"rays": False, "ranges": False, "odometry": False})
        settings = settings.model_copy(update={"noise": noise})
    errors = replace(state.errors.take(*raw), settings=settings)
    attempt = replace(state.attempt(), trace=None, association=None, estimate=None)
    return replace(attempt, keyframes=keyframes, rays=rays, settings=settings, errors=errors)


def _apart(stamps: Floats, camera: Ints) -> Bools:
    """Return a mask (K,) that keeps one keyframe of each camera in each span of `_APART`. stamps: (K,) s."""
    span = np.stack([camera, np.floor((stamps - stamps.min()) / _APART).astype(np.int64)])
    _, first = np.unique(span, axis=1, return_index=True)
    keep = np.zeros(len(stamps), dtype=bool)
    keep[first] = True
    return keep
