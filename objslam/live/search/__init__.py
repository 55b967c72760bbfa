"""Searches the boxes of a running session that belong to no object, in a process beside it. The association of each new
frame is in `live/mapper`."""
