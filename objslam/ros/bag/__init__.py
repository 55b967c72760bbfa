"""Containers of recorded messages: ROS 1 bags, sqlite3 and mcap, whole or damaged, as bytes with topic and stamp.

What the bytes mean is in `ros.messages`.
"""
