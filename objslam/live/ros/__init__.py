"""The ROS messages of a running robot become pushes. `live.adapters` receive them, and `ros` knows their types."""
