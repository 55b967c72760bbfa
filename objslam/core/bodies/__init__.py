"""The bodies of objects, with shape, size and heading. Their upright boxes, footprints and overlaps are here too."""
