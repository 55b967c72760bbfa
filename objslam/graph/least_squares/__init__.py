"""The joint solve as sparse least squares on arrays.

This folder is for code that solves one graph many times, with changed measurements.
"""
