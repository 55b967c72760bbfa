"""Fits bodies to the landmarks of a running session. Bodies describe the objects of a snapshot. Bearings are turned to the
centres of bodies."""
