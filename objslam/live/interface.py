"""The interface between adapters, which push messages, and a session, which maps them."""

from collections.abc import Sequence
from typing import Protocol

from objslam.core.arrays import Floats
from objslam.core.camera import Camera


class Sink(Protocol):
    """Receives messages from any thread. A push returns at once, with False if the message is dropped and counted.

    A message whose stamp leaps ahead may be dropped and counted later, when the next messages refute its stamp.

    No message raises an error, even if it is not finite, goes back in time or names an unknown camera.
    The coordinate frames are `map`, `odom`, `base`, and the optical frame of each camera, which has the camera's name.
    """

    def push_camera(self, camera: Camera) -> bool:
        """Push a calibrated camera. Its base_T_camera is valid until `push_mount` replaces it."""

    def push_odometry(self, stamp: float, odom_T_base: Floats, covariance: Floats | None = None) -> bool:
        """Push odom_T_base (4, 4) at a stamp, s. covariance: (6, 6) of x, y, z (m) and roll, pitch, yaw (rad), as in ROS."""

    def push_localization(self, stamp: float, map_T_base: Floats, covariance: Floats | None = None) -> bool:
        """Push map_T_base (4, 4) of a localisation at a stamp, s. covariance: as in `push_odometry`."""

    def push_mount(self, stamp: float, camera: str, base_T_camera: Floats) -> bool:
        """Push base_T_camera (4, 4) of a camera that moves on the robot. It is valid from the stamp, s, until the next
        mount."""

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
        """Push all boxes of one image. Push images without boxes too, because they show that an expected object is absent.

        stamp: s. boxes: (B, 4) x1, y1, x2, y2, raw px. labels: B names. scores: (B,). depths: (B,) z in m, NaN where
        unknown. track_ids: B ids, -1 where unknown. whole: True if no box is cut off at the image's edge, as with fiducials.
        """
