"""Assign the rays of a solved log again, along the most likely path through its map."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from objslam.association.nearest_neighbour import assign
from objslam.association.observations import PosedRays, observe
from objslam.association.path_search.most_likely_path import most_likely_path
from objslam.association.visibility import detection_history, frames_of
from objslam.config import Settings
from objslam.core.arrays import Floats
from objslam.core.camera import Camera
from objslam.core.types import Association, Keyframes, Rays

if TYPE_CHECKING:
    from objslam.core.estimate import Estimate


def relocalize(
    keyframes: Keyframes,
    rays: Rays,
    cameras: tuple[Camera, ...],
    settings: Settings,
    association: Association,
    estimate: Estimate,
) -> tuple[Floats, Association] | None:
    """Return the most likely path (K, 4, 4) map_T_base through a map, and the objects of the rays along it.

    Objects do not change, but may lose all their rays. None if no label has two objects that could be confused.
    """
    position = estimate.positions
    if not len(position):
        return None
    held = np.where((estimate.weight > 0) & np.isfinite(position[:, 0])[association.object], association.object, -1)
    map_T_camera = estimate.map_T_base @ keyframes.base_T_camera
    obs, ray, keyframe = observe(PosedRays(rays, keyframes, cameras, map_T_camera, rays.sigma))
    view = frames_of(keyframes, keyframe, cameras, map_T_camera, settings, cut=rays.cut)
    history = detection_history(obs, held[ray], np.nan_to_num(position), association.label, view)
    rate = history.seen / np.maximum(history.expected, 1)
    found = most_likely_path(keyframes, rays, estimate.map_T_base, position, association.label, rate)
    if found is None:
        return None
    objects = assign(
        rays,
        position,
        np.nan_to_num(estimate.covariance),
        association.label[:, None] == np.arange(len(rays.label_names)),
        found.map_T_base @ keyframes.base_T_camera,
        rays.sigma,
        pose_covariance=np.broadcast_to(found.pose_covariance, (len(keyframes), 6, 6)),
    )
    return found.map_T_base, Association(objects, association.label)
