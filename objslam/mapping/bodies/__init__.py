"""Bodies of the objects of a solution, from the edges of their boxes.

Whole boxes give all four edges. Boxes that the image's edge cuts off give bounds. In joint mode, the bearings are turned to
the centres of the bodies, and the poses are solved again.
"""
