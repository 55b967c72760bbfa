"""ROS 1 and ROS 2 bags, read without ROS, whole or damaged."""

from __future__ import annotations

from objslam.sources.ros.info import BagInfo, describe
from objslam.sources.ros.log import BagOptions, read_bag
from objslam.sources.ros.recording import is_bag

__all__ = ["BagInfo", "BagOptions", "describe", "is_bag", "read_bag"]
