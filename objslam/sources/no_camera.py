"""The error for a recording that has a path of the robot, but no camera. It carries the path, and poses of cameras in tf."""

from __future__ import annotations

from typing import TYPE_CHECKING

from objslam.errors import LogError

if TYPE_CHECKING:
    from objslam.core.arrays import Floats
    from objslam.core.types import Trajectory


class NoCamera(LogError):
    """A recording without a camera. mounts: base_T_camera (4, 4) from tf, by the name of the optical frame."""

    def __init__(
        self,
        message: str,
        where: str,
        hint: str,
        odometry: Trajectory | None,
        localization: Trajectory | None,
        mounts: dict[str, Floats],
    ) -> None:
        super().__init__(message, where=where, hint=hint)
        self.odometry, self.localization, self.mounts = odometry, localization, mounts

    def with_hint(self, hint: str) -> NoCamera:
        """Return the same error with another hint."""
        return NoCamera(self.message, self.where or "", hint, self.odometry, self.localization, self.mounts)
