"""How well a camera's pose is known, and how well that tells where landmarks lie to it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from objslam.core.arrays import Bools, Floats
from objslam.core.geometry import skew

HORIZON = 0.06
"""Standard deviation of the heading, rad, that the odometry gathers until a landmark counts as long unseen. Larger trusts
single boxes for longer; by then an object 5 m away is predicted to 0.3 m, where another one may stand."""
_PLACED = 0.1
"""Standard deviation of the camera's place in the map, m, below which it tells apart what it saw long ago, too. Larger takes
up old tracks again at a worse pose."""


@dataclass(frozen=True)
class PoseUncertainty:
    """How well the pose of a frame's camera is known.

    drift: (6, 6) covariance that the odometry has gathered by now, in the frame of the course. camera_from_drift: (6, 6)
    adjoint that takes it to the camera's frame. pose: (6, 6) covariance of the pose in the map, in the camera's frame, NaN
    where it is unknown.
    """

    drift: Floats
    camera_from_drift: Floats
    pose: Floats

    @property
    def is_placed(self) -> bool:
        """Whether the camera's place in the map is known well."""
        variance = self.pose.diagonal().tolist()
        return sum(variance[:3]) < HORIZON**2 and sum(variance[3:]) < _PLACED**2

    def of_landmarks(self, to: Floats, then: Floats, map_T_camera: Floats) -> Floats:
        """Covariances (n, 3, 3), m^2, of how landmarks lie to the camera, the landmarks taken as known.

        The lesser counts of two: the drift since a landmark was seen, and the uncertainty of the pose in the map.

        Args:
            to: (n, 3) m from the camera to each landmark, in map.
            then: (n, 6, 6) drift gathered when each was last seen.
            map_T_camera: (4, 4).
        """
        lever = levers(to, map_T_camera)
        back = np.swapaxes(lever, 1, 2)
        since = lever @ (self.camera_from_drift @ gathered(self.drift, then) @ self.camera_from_drift.T) @ back
        placed = lever @ self.pose @ back
        less = np.trace(placed, axis1=1, axis2=2) < np.trace(since, axis1=1, axis2=2)  # never where it is NaN
        return np.where(less[:, None, None], placed, since)

    def against(self, to: Floats, then: Floats) -> Floats:
        """Covariance (6, 6) of the camera's pose against several landmarks at once, in the camera's frame.

        The landmark that was not seen for longest decides. to: (n, 3) m and then: (n, 6, 6) as in `of_landmarks`.
        """
        oldest = then[np.trace(then, axis1=1, axis2=2).argmin()]
        since = self.camera_from_drift @ gathered(self.drift, oldest[None])[0] @ self.camera_from_drift.T
        if not np.isfinite(self.pose).all():
            return since
        reach = float(np.mean(to**2)) * 3
        size = [np.trace(c[:3, :3]) * reach + np.trace(c[3:, 3:]) for c in (since, self.pose)]
        return since if size[0] <= size[1] else self.pose


def levers(to: Floats, map_T_camera: Floats) -> Floats:
    """Jacobians (n, 3, 6) of how landmarks `to` (n, 3) m away lie to the camera, by a small motion in its own frame."""
    turn = map_T_camera[:3, :3]
    lever = np.empty((len(to), 3, 6))
    lever[:, :, :3] = skew(to) @ turn
    lever[:, :, 3:] = -turn
    return lever


def carried(to: Floats, covariance: Floats, map_T_camera: Floats) -> Floats:
    """Covariances (n, 3, 3), m^2, of landmarks `to` (n, 3) m away by that of the camera, (6, 6) in its own frame."""
    lever = levers(to, map_T_camera)
    return np.asarray(lever @ covariance @ np.swapaxes(lever, 1, 2))


def gathered(now: Floats, then: Floats) -> Floats:
    """Drift (n, 6, 6) gathered from `then` (n, 6, 6) to now (6, 6); nothing for a frame from before then."""
    since = now - then
    return np.where((np.trace(since, axis1=1, axis2=2) > 0)[:, None, None], since, 0.0)


def long_unseen(now: Floats, then: Floats) -> Bools:
    """Which things (n,) have been out of sight for long.

    "Long" means that the drift in heading (rad, one standard deviation) since they were last seen is above HORIZON.

    Args:
        now: the drift (6, 6) now.
        then: the drift (n, 6, 6) when each thing was last seen.
    """
    return np.asarray(now[2, 2] - then[:, 2, 2] > HORIZON**2)
