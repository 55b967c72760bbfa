"""Objects from rays whose poses are known: Eq. 1 for a whole log at once, on the rays that agree, in torch.

Which ray belongs to which object is decided in `association`; poses that move with the objects are in `graph`.
"""
