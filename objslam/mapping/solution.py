"""The solution of a log, and the measurements that belong to it."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from objslam.core.arrays import Floats
from objslam.core.bodies.body import PlacedBody
from objslam.core.trace import Round
from objslam.core.types import Association, Keyframes, Rays
from objslam.frontend.shared_errors import SharedErrors

if TYPE_CHECKING:
    from objslam.core.estimate import Estimate


@dataclass(frozen=True)
class Solution:
    """The association, the estimate, and counts of each round.

    keyframes: the solved keyframes, which have at least one ray. rays: their rays, with indices into these keyframes. trace:
    the rounds for the recording, empty without a recording. bodies: the body of each object, None for a point. The tuple is
    None if no bodies were solved. body_share: the standard deviation of the error that the boxes of one side of a body
    share, as a share of half their size. to_centre: (R, 3) what to add to the direction of each ray, in the camera frame, so
    that it points to the centre of its body. None without bodies.
    """

    keyframes: Keyframes
    rays: Rays
    association: Association
    estimate: Estimate
    rounds: tuple[dict[str, int], ...]
    trace: tuple[Round, ...] = ()
    bodies: tuple[PlacedBody | None, ...] | None = None
    body_share: float | None = None
    to_centre: Floats | None = None


def without_errors(errors: SharedErrors, estimate: Estimate) -> tuple[Keyframes, Rays]:
    """Return the keyframes and rays that belong to an estimate: without its shared errors, and with its noise."""
    values = errors.mean if estimate.calibration is None else estimate.calibration.values
    keyframes, rays, _ = with_noise_of(errors, estimate).at(values)
    return keyframes, rays


def with_noise_of(errors: SharedErrors, estimate: Estimate) -> SharedErrors:
    """Return shared errors with the noise of an estimate.

    Lengths keep their measured scale. The shrinkage is corrected only inside a solve.
    """
    noise = errors.noise if estimate.noise is None else estimate.noise
    return errors.with_noise(replace(noise, shrinkage=0.0))


def seen_something(keyframes: Keyframes, rays: Rays) -> tuple[Keyframes, Rays]:
    """Return the keyframes that have a ray, and the rays with indices into them.

    Keyframes without a ray are left out, because they measure no object.
    """
    kept, keyframe = np.unique(rays.keyframe, return_inverse=True)
    return keyframes.take(kept), replace(rays, keyframe=keyframe.astype(np.int64))
