"""The state of association of a finished result: its objects as landmarks, and all its rays as observations."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from objslam.association.gating import gate_limit
from objslam.association.landmarks import Landmarks, State
from objslam.association.observations import PosedRays, observe
from objslam.association.visibility import frames_of
from objslam.core.arrays import Bools, Floats, Ints
from objslam.core.result import RunResult
from objslam.core.types import Keyframes
from objslam.graph.fixed_pose_triangulation import pose_noise

_FAR = 2.0
"""The least distance, in gates, at which a rejected ray shows something else than its object. Rays of the object itself miss
it by less, even with the noise of a bad box. A larger number finds fewer second things of a label."""


@dataclass(frozen=True)
class Evidence:
    """The resolved objects (N) and all rays (R) of a result.

    state: the objects as landmarks, and the rays sorted by frame. object: (N,) the index of each landmark in the map. ray:
    (R,) the index of each observation in the result. left: (R,) whether an observation belongs to no object, or was rejected
    and lies far from its object. covariance: (N, 3, 3) m^2, of the objects' positions. gate: the largest squared deviation
    of a ray from its object.
    """

    state: State
    object: Ints
    ray: Ints
    left: Bools
    covariance: Floats
    gate: float

    @cached_property
    def accepts(self) -> Bools:
        """(N, L) Whether boxes of each label may belong to each landmark."""
        accepts: Bools = self.state.label_count > 0
        accepts[np.arange(self.state.count), self.state.label] = True
        return accepts


def evidence_of(result: RunResult) -> Evidence:
    """Return the evidence of a result. Its landmarks are the resolved objects. Frames without a box count as misses if the
    result has its views."""
    rays, settings, labels = result.rays, result.settings, len(result.rays.label_names)
    if settings.mode == "fixed":
        sigma, place = pose_noise(rays, result.keyframes, settings)
    else:
        sigma, place = rays.sigma, 0.0
    frames, keyframe = all_frames(result)
    poses = frames.map_T_camera
    in_frames = replace(rays, keyframe=keyframe[rays.keyframe])
    obs, ray, order = observe(PosedRays(in_frames, frames, result.cameras, poses, sigma, place))
    obs = replace(obs, origin=result.origins[ray], direction=result.directions[ray])
    objects = result.map.objects
    position = np.array([o.position if o.ray_point is None else o.ray_point for o in objects]).reshape(-1, 3)
    covariance = np.array([o.covariance for o in objects if o.covariance is not None]).reshape(-1, 3, 3)
    known = np.array([j for j, o in enumerate(objects) if o.covariance is not None], dtype=np.int64)
    number = np.full(len(objects) + 1, -1)
    number[known] = np.arange(len(known))
    matched = number[result.association.object[ray]]
    label = result.association.label[known]
    view = frames_of(frames, order, result.cameras, poses, settings, cut=rays.cut)
    state = State(obs, view, Landmarks.new(position[known], np.ones(len(known)), label, labels), matched)
    state = replace(state, landmarks=replace(state.landmarks, noise=state.noise))
    gate = gate_limit(settings.association.gate)
    left = result.association.object[ray] < 0
    far = state.deviation > _FAR * np.sqrt(gate)
    left[state.assigned[far & (result.weight[ray[state.assigned]] == 0)]] = True
    return Evidence(state, known, ray, left, covariance, gate)


def all_frames(result: RunResult) -> tuple[Keyframes, Ints]:
    """Return all camera frames of a drive at their solved poses, and the index (K,) of each keyframe among them.

    A result without views has only the keyframes.
    """
    keyframes, views = replace(result.keyframes, map_T_base=result.map_T_base), result.views
    own = np.arange(len(keyframes))
    if views is None or not len(views):
        return keyframes, own
    most = int(max(views.frame.max(), keyframes.frame.max(initial=0))) + 1
    key, wanted = views.camera * most + views.frame, keyframes.camera * most + keyframes.frame
    order = np.argsort(key, kind="stable")
    found = order[np.minimum(np.searchsorted(key[order], wanted), len(key) - 1)]
    return (views, found) if (key[found] == wanted).all() else (keyframes, own)
