"""Uneven ground below planar poses.

Planar poses lack roll, pitch and height, so rays have more noise up and down than to the sides.
"""
