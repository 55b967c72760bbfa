"""The function by which a driver reports its progress."""

from collections.abc import Callable

Progress = Callable[[str, int, int], None]
"""A function of the stage's name, the work done, and the total work (0 if the total is unknown)."""
