"""The function by which a driver reports its progress."""

from collections.abc import Callable

Progress = Callable[[str, int, int], None]
"""A function of the stage's name, the number of steps done, and the total number of steps (0 if unknown)."""
