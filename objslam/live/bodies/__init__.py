"""Bodies of the landmarks of a running session. They describe the objects of a snapshot. Bearings are turned to their
centres.
"""
