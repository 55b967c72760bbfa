"""Estimates the errors that all measurements of a robot share, and the noise of its measurements.

In joint mode this happens around the solve of poses and landmarks, else against known poses.
"""
