"""Decide from appearance how likely two boxes show one object. The cosine between two appearance vectors gives a likelihood
ratio, which is learnt from the log itself. Without appearance vectors, this folder has no effect."""
