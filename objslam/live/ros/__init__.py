"""Turns the ROS messages of a running robot into pushes. `live.adapters` receive the messages, and `ros` decodes them."""
