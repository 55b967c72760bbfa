"""Decide from appearance how likely two boxes show one object. The likelihood ratio of cosines is learnt from the log
itself. Without appearance vectors, nothing in this folder changes anything."""
