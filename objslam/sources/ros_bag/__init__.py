"""Read ROS 1 and ROS 2 bags, including damaged ones, without a ROS installation. `objslam.ros` reads the file formats."""
