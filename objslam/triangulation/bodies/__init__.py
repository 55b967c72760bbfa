"""The bodies of objects: upright ellipsoids, cuboids and cylinders, their fit to the edges of boxes, and the choice of one.

A body has seven parameters. All objects of a map are solved in one batch, in numpy.
"""
