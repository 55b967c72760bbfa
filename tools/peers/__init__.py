"""The same planar drives, with names known, for objslam and for graphs written by hand."""
