"""ROS messages of a live robot: which topics to take, and what each message tells a session.

How messages arrive is in `live.adapters`; what they mean by themselves is in `ros`.
"""
