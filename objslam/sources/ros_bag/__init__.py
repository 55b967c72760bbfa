"""ROS 1 and ROS 2 bags, read without ROS, whole or damaged: which topics play which part, and the log that comes of it.

Containers, messages and transforms themselves are in `ros`, which live robots share.
"""
