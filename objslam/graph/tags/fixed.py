"""The rotation and size of fiducials at given camera poses. Their positions are triangulated like those of other objects."""

import numpy as np

from objslam.config import Settings
from objslam.core.object_map import TagPose
from objslam.core.rotation import quaternion_from_rotation
from objslam.core.types import Association, Keyframes, Rays
from objslam.graph.fixed_pose_triangulation import pose_noise
from objslam.graph.tags.corner_rays import TagCorners
from objslam.graph.tags.estimate import LEAST_PROBABILITY
from objslam.graph.tags.placement import place
from objslam.graph.tags.square_fit import Corners, fit, scatter

_NOMINAL = 4.0
"""The number of views at which the scatter of the views and the nominal noise have equal weight in the covariance. From this
number on, a fit to all views leaves a known size free. A larger number leaves more to the nominal noise."""
_STEPS = 5
"""The iterations of a fit to all views. It starts at a pose that fits some of the views. More iterations are slower."""


def tags_at_poses(keyframes: Keyframes, rays: Rays, association: Association, settings: Settings) -> dict[int, TagPose]:
    """Return the rotation and size of each fiducial by the index of its object, from all its views at fixed poses.

    The error of a pose is common to the four corners of a view, so the covariance comes from the scatter of whole views, and
    for few views also from the nominal noise. A fiducial whose views do not tell its size has no entry.
    """
    tags = TagCorners.of(rays, association, settings)
    if tags is None:
        return {}
    seen = tags.seen(tags.rays(rays), keyframes.map_T_camera)
    found = place(seen, tags.shape, tags.side)
    angle, shift = pose_noise(rays, keyframes, settings)
    source = tags.source[tags.first]
    away = np.linalg.norm(found.best.pose[seen.square, :3, 3] - seen.origin, axis=1)
    of_pose = np.maximum(angle[source] ** 2 - rays.sigma[source] ** 2, 0.0) + (shift / away) ** 2
    seen = Corners(seen.square, seen.origin, seen.direction, np.sqrt(seen.sigma**2 + of_pose))
    # If the poses of views err, a fixed size would turn the tag to explain distances that do not agree.
    number = np.bincount(seen.square, minlength=len(tags.side))
    known = np.isfinite(tags.side)
    free = ~known | (number >= _NOMINAL)
    best, cost, information = fit(seen, found.best, free, _STEPS)
    other, other_cost, _ = fit(seen, found.other, free, _STEPS)
    told = np.flatnonzero(np.isfinite(found.cost))
    nominal = np.linalg.inv(information[told])
    between = nominal @ scatter(seen, best, free)[told] @ nominal
    share = (_NOMINAL / (_NOMINAL + number[told]))[:, None, None]
    covariance = share * nominal + (1 - share) * between
    gain = np.where(np.isfinite(found.other_cost), other_cost - cost, np.inf)
    probability = 1 / (1 + np.exp(np.clip(gain / 2, -50.0, 50.0)))
    xyzw, other_xyzw = (quaternion_from_rotation(one.pose[:, :3, :3]) for one in (best, other))
    return {
        int(tags.object[t]): TagPose(
            xyzw=xyzw[t],
            covariance=(covariance[i, :3, :3] + covariance[i, :3, :3].T) / 2,
            size=float(tags.side[t] if known[t] else best.side[t]),
            size_sigma=0.0 if known[t] else float(best.side[t] * np.sqrt(covariance[i, 6, 6])),
            other_xyzw=other_xyzw[t] if probability[t] >= LEAST_PROBABILITY else None,
            other_probability=float(probability[t]) if probability[t] >= LEAST_PROBABILITY else 0.0,
        )
        for i, t in enumerate(told.tolist())
    }
