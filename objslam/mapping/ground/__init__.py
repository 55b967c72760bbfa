"""Find uneven ground below planar poses.

Planar poses do not say how the robot rolls, pitches and rises. The boxes show it, because all rays of a pose move together.
"""
