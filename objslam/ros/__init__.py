"""ROS without ROS: files of bags, messages and tf, shared by recorded bags and by live robots.

Which topic plays which part is decided where a log or a session is made: `sources.ros_bag` and `live.ros`.
"""
