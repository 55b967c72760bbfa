"""The data types that every room shares, and the mathematics on them: poses, rays, objects, results, statistics.

Nothing here reads or writes a file, and nothing here knows a solver or a message; files are in `io`.
"""
