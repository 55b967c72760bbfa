"""The offline driver: a whole log becomes a map of objects, in turns of association and solve.

The live driver is `live`; what a result looks like on disk or on the screen is `output`.
"""
