"""The bodies of objects: shape, size and heading. Upright boxes, their footprints and their overlap belong to them."""
