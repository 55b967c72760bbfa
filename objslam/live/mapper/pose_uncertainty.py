"""The uncertainty of a camera pose, and the uncertainty of landmarks relative to the camera."""

from dataclasses import dataclass

import numpy as np

from objslam.core.arrays import Bools, Floats
from objslam.core.rotation import skew

HORIZON = 0.06
"""The heading drift (rad, one sigma) since a landmark's last observation above which the landmark is long unseen. This drift
moves a landmark at 5 m by 0.3 m, perhaps to the place of a neighbour. With a larger value, single boxes match landmarks
after a longer absence."""
_PLACED = 0.1  # The sigma (m) of the camera position below which long unseen tracks match. A larger value matches more.


@dataclass(frozen=True)
class PoseUncertainty:
    """The uncertainty of a frame's camera pose. Covariances are in rad and m, rotation first.

    drift: (6, 6) covariance that the odometry has accumulated, in the frame of the course. camera_from_drift: (6, 6) adjoint
    from that frame to the camera frame. pose: (6, 6) covariance of the pose in map, in the camera frame, NaN if unknown.
    """

    drift: Floats
    camera_from_drift: Floats
    pose: Floats

    @property
    def is_placed(self) -> bool:
        """Whether the camera pose in the map is certain."""
        variance = self.pose.diagonal().tolist()
        return sum(variance[:3]) < HORIZON**2 and sum(variance[3:]) < _PLACED**2

    def of_landmarks(self, to: Floats, then: Floats, map_T_camera: Floats) -> Floats:
        """Return the covariances (n, 3, 3), m^2, that the camera pose adds to landmarks relative to the camera.

        Each is the smaller of two covariances. One is from the drift since the landmark was seen, the other from the pose in
        the map. to: (n, 3) m from the camera to each landmark, in map. then: (n, 6, 6) drift when each landmark was last
        seen.
        """
        turn = map_T_camera[:3, :3]
        lever = np.empty((len(to), 3, 6))  # The Jacobians for small motions of the camera in its own frame.
        lever[:, :, :3] = skew(to) @ turn
        lever[:, :, 3:] = -turn
        back = np.swapaxes(lever, 1, 2)
        since = lever @ (self.camera_from_drift @ gathered(self.drift, then) @ self.camera_from_drift.T) @ back
        placed = lever @ self.pose @ back
        less = np.trace(placed, axis1=1, axis2=2) < np.trace(since, axis1=1, axis2=2)  # False for NaN.
        return np.where(less[:, None, None], placed, since)

    def against(self, to: Floats, then: Floats) -> Floats:
        """Return the covariance (6, 6) of the camera pose relative to several landmarks together, in the camera frame.

        It is the smaller of two covariances. One is from the drift since the longest unseen landmark was seen, the other
        from the pose in the map. to: (n, 3) m from the camera to each landmark. then: (n, 6, 6) drift when each landmark was
        last seen.
        """
        oldest = then[np.trace(then, axis1=1, axis2=2).argmin()]
        since = self.camera_from_drift @ gathered(self.drift, oldest[None])[0] @ self.camera_from_drift.T
        if not np.isfinite(self.pose).all():
            return since
        reach = float(np.mean(to**2)) * 3
        size = [np.trace(c[:3, :3]) * reach + np.trace(c[3:, 3:]) for c in (since, self.pose)]
        return since if size[0] <= size[1] else self.pose


def gathered(now: Floats, then: Floats) -> Floats:
    """Return the drift (n, 6, 6) that accumulated from `then` (n, 6, 6) to `now` (6, 6), or 0 if `now` is earlier."""
    since = now - then
    return np.where((np.trace(since, axis1=1, axis2=2) > 0)[:, None, None], since, 0.0)


def long_unseen(now: Floats, then: Floats) -> Bools:
    """Return which objects (n,) are long unseen (HORIZON).

    now: (6, 6) current drift. then: (n, 6, 6) drift when each object was last seen.
    """
    return np.asarray(now[2, 2] - then[:, 2, 2] > HORIZON**2)
