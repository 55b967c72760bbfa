"""The error for a recording with a path of the robot, but without images and boxes. The error contains the usable data."""

from __future__ import annotations

from typing import TYPE_CHECKING

from objslam.errors import LogError

if TYPE_CHECKING:
    from objslam.core.arrays import Floats
    from objslam.core.trajectory import Trajectory
    from objslam.core.types import CameraLog


class NoCamera(LogError):
    """The recording has no images and no boxes.

    odometry, localization: the robot's paths, None if unknown. cameras: the cameras that are known from a CameraInfo or from
    a file. mounts: maps the name of each optical frame to its base_T_camera (4, 4) from tf.
    """

    def __init__(
        self,
        message: str,
        where: str,
        hint: str,
        odometry: Trajectory | None,
        localization: Trajectory | None,
        mounts: dict[str, Floats],
        cameras: tuple[CameraLog, ...] = (),
    ) -> None:
        super().__init__(message, where=where, hint=hint)
        self.odometry, self.localization, self.mounts, self.cameras = odometry, localization, mounts, cameras

    def with_hint(self, hint: str) -> NoCamera:
        """Return the same error with another hint."""
        paths = self.odometry, self.localization
        return NoCamera(self.message, self.where or "", hint, *paths, self.mounts, self.cameras)
