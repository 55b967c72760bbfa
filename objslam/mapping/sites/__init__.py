"""Maps of many sessions. They are compared, brought into one frame, and joined to the map of a site.

A session is one run, in a frame of its own. A site is the map of all of them, with the life of each object.
"""
