"""Live: makes and shows the map while the robot drives. `mapping` makes the map of a complete log."""
