"""The pictures: map.png, the changes between maps, and the boxes on a photo. Also the colours, captions and label positions
that all outputs share.

The 3D recording is in `viewer`, and the HTML page is in `report`.
"""
