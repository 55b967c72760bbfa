"""The joint solve as sparse least squares on arrays.

It is for code that solves a graph many times with other measurements.
"""
