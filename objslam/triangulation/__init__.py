"""Triangulates all objects of a log at once from rays with known poses, by Eq. 1 on the rays that agree.

`association` decides which ray belongs to which object, and `graph` optimises poses together with objects.
"""
