"""Explore a log without a localisation, where nobody knows which box shows which object.

The result is a first path and association. A second exploration with looser odometry shows whether the first one is right.
"""
