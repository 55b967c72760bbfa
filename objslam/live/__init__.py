"""Live: the map while the robot drives, shown and published as it grows.

A log that is complete is mapped by `mapping`; the session here shares its rooms with it, but for the driver.
"""
