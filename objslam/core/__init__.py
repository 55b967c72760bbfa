"""The data types that every room shares, and the mathematics of poses, rays, objects and statistics.

Nothing here reads or writes a file, runs a solver or handles messages.
"""
