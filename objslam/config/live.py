"""The settings of a live session."""

from typing import Annotated

from pydantic import Field

from objslam.config.section import Count, NotNegative, Positive, Section, Share


class Live(Section):
    """Configure the mapping while the robot drives."""

    keyframe_distance: NotNegative = 0.01
    """Camera motion in m since the last keyframe that makes a frame a keyframe. The first ten frames of a camera at rest are
    keyframes too."""
    keyframe_angle_deg: NotNegative = 0.5
    """Camera rotation in degrees since the last keyframe that makes a frame a keyframe. A frame is also a keyframe if the
    keyframes at the current place lack one of its labels."""
    max_keyframes: Annotated[int, Field(ge=50)] = 1500
    """Maximum number of keyframes, to bound memory and time. Above it, a quarter of the older keyframes is removed with
    their boxes, and the odometry across each removed keyframe is composed."""
    max_lag: Positive = 0.35
    """Maximum waiting time of a frame in s. A frame that waits longer is dropped and counted."""
    max_late: Positive = 2.0
    """Maximum time in s by which the timestamp of a frame may be older than the newest pose."""
    max_frames_waiting: Count = 64
    """Maximum number of waiting frames. Above it, the oldest frame is dropped and counted."""
    max_speed: Positive = 5.0
    """Speed in m/s above which odometry counts as a jump. A turn above four times this number in rad/s is also a jump. After
    a jump, odometry continues from the last pose."""
    min_rays: Annotated[int, Field(ge=3)] = 5
    """Minimum number of consistent boxes before an object enters the graph. It exceeds association.min_rays, because a live
    session knows only the current poses."""
    ghost_share: Share = 0.1
    """Share of detections among the frames that should show an object. Below it, the object is dropped as false. A larger
    value drops more objects, and also true objects."""
    ghost_frames: Count = 40
    """Minimum number of frames that should show an object before it can be dropped as false. A larger value keeps false
    objects longer."""
    reassociate: Annotated[int, Field(ge=0)] = 6000
    """Maximum number of boxes for a repeated offline association at the end of a session, which takes a few seconds."""
    forget: Positive = 5.0
    """Time in s without an observation after which a track with fewer than min_rays boxes is dropped. Its boxes stay
    unexplained."""
