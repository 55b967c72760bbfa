"""ROS messages by type: bytes to fields, and fields to poses, boxes, cameras and images.

Which topics to read is not decided here; transforms over time are in `ros.tf`.
"""
