"""Draw the pictures: map.png, the changes between maps, and the boxes on a photo.

This package also has the colours, captions and label positions of all outputs. The 3D recording is made in `viewer`, and the
HTML page in `report`.
"""
