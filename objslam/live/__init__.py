"""Live: the map of a running robot, which is shown while it grows. `mapping` maps a complete log offline."""
