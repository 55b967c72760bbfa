"""Triangulate all objects of a log at once, at known poses, from the rays that agree, by Eq. 1 of Staszak and Belter.

`association` decides which ray belongs to which object, and `graph` optimises poses together with objects.
"""
