"""The bodies of objects, upright ellipsoids and cuboids: geometry, the fit to the edges of boxes, and the choice of a shape.

A body has seven parameters. All objects of a map are solved in one batch, in numpy.
"""
