"""Estimate the shared errors of a robot, and the noise of its measurements.

Shared errors are constant errors that all measurements of an instrument share, such as the offset of a camera's clock, its
rotation on the robot, and the scale of the odometry.

In joint mode, the estimation surrounds the solve of poses and landmarks. In fixed mode, it uses the known poses.
"""
