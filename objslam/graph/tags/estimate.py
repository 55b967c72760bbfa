"""Turn the four corners of each fiducial back into one object: position, rotation and size, each with its covariance."""

from collections.abc import Callable, Sequence
from dataclasses import replace

import gtsam
import numpy as np

from objslam.core.arrays import Floats, Ints
from objslam.core.bodies.tag_pose import TagPose
from objslam.core.diagnostics import Ledger
from objslam.core.estimate import Estimate
from objslam.core.rotation import quaternion_from_rotation, rotation_vector
from objslam.core.types import Rays
from objslam.graph.optimizers import indeterminate
from objslam.graph.tags.corner_rays import TagCorners
from objslam.graph.tags.placement import place
from objslam.graph.tags.shapes import squares_of, turned_by_squares
from objslam.graph.variables import L0, TAG0, TAG_SIZE0

Covariances = Callable[[Sequence[Sequence[int]]], list[Floats]]
"""A function of groups of keys that returns the covariance of each group, as `marginals.joint_covariances` does."""
LEAST_PROBABILITY = 0.01
"""The least probability of a second rotation of a flat square that is reported. A larger value reports fewer rotations."""


def with_objects(
    estimate: Estimate,
    tags: TagCorners,
    rays: Rays,
    map_T_camera: Floats,
    values: gtsam.Values,
    covariances: Covariances,
    wider: Floats,
    sensitivity: Floats | None,
    ledger: Ledger,
) -> Estimate:
    """Return the estimate of N objects and R rays, from an estimate of the M landmarks and n new rays of `TagCorners`.

    The weight of a ray is the mean weight of its new rays. A second pose that the views leave open widens the covariances by
    the distance between the two poses, weighted by their probabilities.

    Args:
        rays: (n,) the new rays. map_T_camera: (P, 4, 4) the solved camera poses.
        values: the solved values of the graph. covariances: the function that returns covariances of its variables.
        wider: (M,) the factor on the covariance of each landmark.
        sensitivity: (M, 3, P) the derivatives of the landmarks by the shared errors of `estimate.calibration`, None without
            such errors.
        ledger: gets a warning if the graph has no covariances.
    """
    which = tags.tied(np.flatnonzero(estimate.solved))
    corners = estimate.positions[tags.landmarks]
    object_ = tags.object
    positions, covariance = estimate.positions[: tags.count].copy(), estimate.covariance[: tags.count].copy()
    solved = estimate.solved[: tags.count].copy()
    positions[object_], covariance[object_], solved[object_] = corners.mean(axis=1), np.nan, False
    found: dict[int, TagPose] = {}
    spread = _marginals(values, covariances, tags, which, ledger)
    if len(which) and spread is not None:
        rotation, centre, side = squares_of(corners[which], tags.shape[which])
        side = np.where(np.isfinite(tags.side[which]), tags.side[which], side)
        spread = spread * wider[object_[which], None, None]
        if sensitivity is not None and estimate.calibration is not None:
            by_error = _of_squares(tags.shape[which] * side[:, None, None], rotation) @ sensitivity[
                tags.landmarks[which]
            ].reshape(len(which), 12, -1)
            spread = spread + by_error @ estimate.calibration.covariance @ np.swapaxes(by_error, 1, 2)
        other, probability, apart = _second(tags, rays, map_T_camera, which, rotation, wider)
        share = (probability * (1 - probability))[:, None, None]
        turn = rotation_vector(np.swapaxes(rotation, 1, 2) @ other)
        spread[:, :3, :3] += share * turn[:, :, None] * turn[:, None, :]
        of_place = rotation @ spread[:, 3:6, 3:6] @ np.swapaxes(rotation, 1, 2)
        covariance[object_[which]] = of_place + share * apart[:, :, None] * apart[:, None, :]
        positions[object_[which]], solved[object_[which]] = centre, True
        xyzw, other_xyzw = quaternion_from_rotation(rotation), quaternion_from_rotation(other)
        told = probability >= LEAST_PROBABILITY
        for i, j in enumerate(object_[which].tolist()):
            found[j] = TagPose(
                xyzw=xyzw[i],
                covariance=(spread[i, :3, :3] + spread[i, :3, :3].T) / 2,
                size=float(side[i]),
                size_sigma=float(side[i] * np.sqrt(spread[i, 6, 6])),
                other_xyzw=other_xyzw[i] if told[i] else None,
                other_probability=float(probability[i]) if told[i] else 0.0,
            )
    number = np.bincount(tags.source)
    return replace(
        estimate,
        positions=positions,
        covariance=(covariance + np.swapaxes(covariance, 1, 2)) / 2,
        solved=solved,
        seen_sigma=estimate.seen_sigma[: tags.count],
        weight=np.bincount(tags.source, estimate.weight) / number,
        tags=found,
    )


def _marginals(
    values: gtsam.Values, covariances: Covariances, tags: TagCorners, which: Ints, ledger: Ledger
) -> Floats | None:
    """Return the covariances (t, 7, 7) of fiducials: rotation (rad) and position (m) in their own frames, then the logarithm
    of their side. If the linear system is indeterminate, return None, and warn in the ledger."""
    covariance = np.zeros((len(which), 7, 7))
    free = np.flatnonzero(~np.isfinite(tags.side[which]))
    keys = [(TAG0 + t,) for t in which.tolist()] + [(TAG_SIZE0 + t,) for t in which[free].tolist()]
    try:
        found = covariances(keys)
    except RuntimeError as error:
        ledger.warn(f"rotations of fiducials: {indeterminate(error).message}")
        return None
    for i in range(len(which)):
        covariance[i, :6, :6] = found[i]
    for i, of_size in zip(free.tolist(), found[len(which) :], strict=True):
        t = int(which[i])
        reach = np.linalg.norm(values.atPose3(TAG0 + t).translation() - values.atPoint3(L0 + int(tags.landmarks[t, 0])))
        covariance[i, 6, 6] = of_size[0, 0] / reach**2
    return covariance


def _of_squares(local: Floats, rotation: Floats) -> Floats:
    """Return the derivatives (t, 7, 12) of fitted squares by their corners in map: the pseudoinverse of
    `turned_by_squares`."""
    return np.asarray(np.linalg.pinv(turned_by_squares(local, rotation)), dtype=np.float64)


def _second(
    tags: TagCorners, rays: Rays, map_T_camera: Floats, which: Ints, rotation: Floats, wider: Floats
) -> tuple[Floats, Floats, Floats]:
    """Return the second rotations (t, 3, 3) of fiducials, their probabilities (t,), and the shifts (t, 3) m from the first
    positions to the second.

    which: (t,) the fiducials. rotation: (t, 3, 3) the solved rotations. wider: (M,) as in `with_objects`. Both poses are
    compared at the solved camera poses, as if one of the two were the truth.
    """
    found = place(tags.seen(rays, map_T_camera), tags.shape, tags.side)
    best, other = found.best.take(which), found.other.take(which)
    cost = np.where(np.isfinite(found.cost), found.cost, 0.0)  # Without a pose, the other cost is also infinite.
    gain = (found.other_cost - cost)[which] / wider[tags.object[which]]
    off = [np.linalg.norm(rotation_vector(np.swapaxes(rotation, 1, 2) @ o.pose[:, :3, :3]), axis=1) for o in (best, other)]
    swapped = (off[1] < off[0]) & np.isfinite(gain)
    turned = np.where(swapped[:, None, None], best.pose[:, :3, :3], other.pose[:, :3, :3])
    way = (other.pose[:, :3, 3] - best.pose[:, :3, 3]) * np.where(swapped, -1.0, 1.0)[:, None]
    gain = np.where(swapped, -gain, gain)
    return turned, 1 / (1 + np.exp(np.clip(gain / 2, -50.0, 50.0))), np.where(np.isfinite(gain)[:, None], way, 0.0)
