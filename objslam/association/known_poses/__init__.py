"""Association at known poses: the search for an unknown number of objects among the rays.

The evidence of each object decides whether it exists: how unlikely its rays meet by chance, its detections and misses, its
size, and whether it rests.
"""
