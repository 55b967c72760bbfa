"""Read ROS 1 and ROS 2 bags, including damaged ones, without a ROS installation. The formats are in `objslam.ros`."""
