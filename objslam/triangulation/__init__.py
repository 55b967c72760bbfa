"""Triangulates all objects of a log at once from the rays that agree, at known poses, by Eq. 1 of Staszak and Belter.

`association` decides which ray belongs to which object, and `graph` optimises poses together with objects.
"""
