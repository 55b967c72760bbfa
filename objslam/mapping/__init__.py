"""The offline driver, which alternates association and solve until a whole log has become a map of objects.

The live driver is in `live`, and the output on disk or screen is in `output`.
"""
