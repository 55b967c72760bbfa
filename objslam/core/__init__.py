"""The data types that all packages share, and the mathematics of poses, rays, objects and statistics.

Nothing here reads or writes a file, runs a solver or handles messages.
"""
