"""Read ROS bags, messages and tf without a ROS installation. Topics are chosen in `sources.ros_bag` and `live.ros`."""
