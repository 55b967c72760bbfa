"""Read ROS bags, messages and tf without a ROS installation, for recorded bags and for live robots.

The choice of the topic for each role is in `sources.ros_bag` and `live.ros`.
"""
