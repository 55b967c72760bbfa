"""Upright ellipsoids as the bodies of objects: geometry, the fit to the edges of boxes, and the choice of a shape.

numpy only. A body is nine numbers, and all objects of a map are solved in one batch.
"""
