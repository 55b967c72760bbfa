"""The picture map.png, and the colours, labels and extents that all pictures share.

The 3D recording is in `viewer`, the page in `report`.
"""
