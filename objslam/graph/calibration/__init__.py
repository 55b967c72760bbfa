"""Estimate the errors that all measurements of a robot share, and the noise of these measurements.

In joint mode, the estimation surrounds the solve of poses and landmarks. In fixed mode, it uses the known poses.
"""
