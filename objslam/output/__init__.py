"""Everything that a result becomes: the result folder, the picture, the recording, the report, the exports.

Nothing here computes a map; what reads a result back is `results`.
"""
