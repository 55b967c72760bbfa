"""What an adapter pushes, and what a session shows of itself: the seam between middleware and the map."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

from objslam.core.arrays import Floats
from objslam.core.camera import Camera


class Sink(Protocol):
    """Where messages go. A push returns at once: True, accepted, or False, dropped and counted.

    Callable from any thread. No message, however bad (not finite, back in time, a camera that nobody knows), raises.
    Frames as everywhere: `map`, `odom`, `base`, and a camera's optical frame, which goes by the camera's name.
    """

    def push_camera(self, camera: Camera) -> bool:
        """A calibrated camera (a CameraInfo, say); its base_T_camera holds until a transform says otherwise."""
        ...

    def push_odometry(self, stamp: float, odom_T_base: Floats, covariance: Floats | None = None) -> bool:
        """odom_T_base (4, 4) at stamp, s; covariance: (6, 6) in the order of ROS, x, y, z, roll, pitch, yaw."""
        ...

    def push_localization(self, stamp: float, map_T_base: Floats, covariance: Floats | None = None) -> bool:
        """map_T_base (4, 4) at stamp, s, from a localisation; covariance likewise."""
        ...

    def push_mount(self, stamp: float, camera: str, base_T_camera: Floats) -> bool:
        """base_T_camera (4, 4) of a camera that moves on the robot, from this stamp, s, until the next."""
        ...

    def push_detections(
        self,
        stamp: float,
        camera: str,
        boxes: Floats,
        labels: Sequence[str],
        scores: Floats,
        depths: Floats | None = None,
        track_ids: Sequence[int] | None = None,
        whole: bool = False,
    ) -> bool:
        """All boxes of one image: (B, 4) raw px, labels B, scores (B,), depths (B,) z in m or NaN, track_ids B or -1.

        An image without a box is pushed too: what was not seen is evidence. whole: as `types.Detections` has it, for
        fiducials, which are used up to the image's edge.
        """
        ...
