"""Triangulates objects from rays with known poses: Eq. 1 for a whole log at once, on the rays that agree, in torch.

`association` decides which ray belongs to which object, and `graph` optimises poses together with objects.
"""
