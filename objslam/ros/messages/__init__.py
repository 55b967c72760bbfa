"""Decode ROS messages and convert them to poses, boxes, cameras and images. Transforms over time are in `ros.tf`."""
