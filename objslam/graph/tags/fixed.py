"""The rotation and size of fiducials at given camera poses. Their positions are triangulated as for other objects."""

import numpy as np

from objslam.config import Settings
from objslam.core.arrays import Floats
from objslam.core.bodies.tag_pose import TagPose
from objslam.core.rotation import quaternion_from_rotation
from objslam.core.types import Association, Keyframes, Rays
from objslam.graph.fixed_pose_triangulation import pose_noise
from objslam.graph.tags.corner_rays import TagCorners
from objslam.graph.tags.estimate import LEAST_PROBABILITY
from objslam.graph.tags.placement import place
from objslam.graph.tags.square_fit import fit, scatter, with_pose_noise

_NOMINAL = 30.0
"""The number of views of a fiducial with which half of their excess scatter counts. The excess is the scatter of the views
minus the nominal noise. A fiducial has seven parameters, so the scatter of n views gives a variance with a relative error of
about sqrt(7 / n). With 30 views, this error is a half. With a larger number, the nominal noise counts more."""
_STEPS = 5
"""The number of iterations of a fit to all views, from a pose that fits some of the views. More iterations are slower."""


def tags_at_poses(keyframes: Keyframes, rays: Rays, association: Association, settings: Settings) -> dict[int, TagPose]:
    """Return the rotation and size of each fiducial by the index of its object, from all its views at fixed poses.

    The error of a camera pose is common to the four corners of a view (`square_fit.with_pose_noise`). The covariance follows
    from the nominal noise, and is larger if the views scatter more. A fiducial has no entry if its views do not determine
    its size.
    """
    tags = TagCorners.of(rays, association, settings)
    if tags is None:
        return {}
    seen = tags.seen(tags.rays(rays), keyframes.map_T_camera)
    found = place(seen, tags.shape, tags.side)
    angle, shift = pose_noise(rays, keyframes, settings)
    source = tags.source[tags.first]
    turn = np.sqrt(np.maximum(angle[source] ** 2 - rays.sigma[source] ** 2, 0.0))
    seen = with_pose_noise(seen, found.best, turn, np.broadcast_to(shift, rays.sigma.shape)[source])
    found = place(seen, tags.shape, tags.side)
    number = np.bincount(seen.square, minlength=len(tags.side))
    known = np.isfinite(tags.side)
    best, cost, information = fit(seen, found.best, ~known, _STEPS)
    other, other_cost, _ = fit(seen, found.other, ~known, _STEPS)
    told = np.flatnonzero(np.isfinite(found.cost))
    nominal = np.zeros_like(information)
    nominal[told] = np.linalg.inv(information[told])
    between = nominal @ scatter(seen, best, ~known, nominal) @ nominal
    share = (number / (_NOMINAL + number))[told, None, None]
    covariance = nominal[told] + share * _excess(between[told], nominal[told])
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


def _excess(covariance: Floats, nominal: Floats) -> Floats:
    """Return by how much covariances (n, d, d) exceed the nominal covariances, in the directions in which they are
    larger."""
    root = np.linalg.cholesky(nominal)
    inverse = np.linalg.inv(root)
    ratio, axes = np.linalg.eigh(inverse @ covariance @ np.swapaxes(inverse, 1, 2))
    axes = root @ axes
    return np.asarray((axes * np.maximum(ratio - 1, 0.0)[:, None, :]) @ np.swapaxes(axes, 1, 2))
