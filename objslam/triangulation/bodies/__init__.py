"""Fit a body to the edges of each object's boxes, and choose its shape.

A body is an upright ellipsoid, cuboid or cylinder with seven parameters. All objects of a map are solved in one batch, in
numpy.
"""
