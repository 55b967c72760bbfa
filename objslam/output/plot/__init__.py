"""The picture map.png, and the colours, captions and label positions that all outputs share.

The 3D recording is in `viewer`, and the HTML page is in `report`.
"""
