"""Decode ROS messages and convert them to poses, boxes, cameras and images.

The choice of topics is in the rooms above, and transforms over time are in `ros.tf`.
"""
