"""The settings of a live session."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from objslam.config.section import NotNegative, Positive, Section, Share


class Live(Section):
    """Mapping while the robot drives."""

    keyframe_distance: NotNegative = 0.01
    """m; a frame becomes a keyframe once its camera has moved this far since the last one. While it stands
    still, the first ten frames are taken."""
    keyframe_angle_deg: NotNegative = 0.5
    """degrees; a frame also becomes a keyframe once its camera has turned this far, or shows a label that the keyframes
    since then do not have."""
    max_keyframes: Annotated[int, Field(ge=50)] = 1500
    """keyframes at the most. When there are more, a quarter of the older ones is left out with its boxes, and the odometry
    across it is summed up, so that memory and time stay bounded."""
    max_lag: Positive = 0.35
    """s; a frame that waited for longer is dropped and counted."""
    max_late: Positive = 2.0
    """s; how far behind the newest pose a frame's stamp may be."""
    max_frames_waiting: Annotated[int, Field(ge=1)] = 64
    """frames that may wait at the most; of more, the oldest is dropped and counted."""
    max_speed: Positive = 5.0
    """m/s; odometry that moves faster, or turns faster than four times this number in rad/s, has jumped. It is taken to have
    started again where it was."""
    min_rays: Annotated[int, Field(ge=3)] = 5
    """boxes that must agree before an object enters the graph; more than association.min_rays, for live the poses of the
    moment are all there is."""
    ghost_share: Share = 0.1
    """share of the frames that should show an object, below which it is dropped as false. Larger drops more, and right ones
    too."""
    ghost_frames: Annotated[int, Field(ge=1)] = 40
    """frames that should have shown an object before it may be dropped for that. Larger keeps wrong ones for longer."""
    reassociate: Annotated[int, Field(ge=0)] = 6000
    """boxes up to which everything is associated once more at the end, as offline; that takes some seconds."""
    forget: Positive = 5.0
    """s; a track of fewer than min_rays boxes that is not seen for longer is given up, and its boxes stay unexplained."""
