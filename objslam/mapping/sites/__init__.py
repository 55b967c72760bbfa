"""Compare the maps of many sessions, and join them to the map of a site.

A session is one run, in a frame of its own. A site is the map of all sessions of one place, with the life of each object.
"""
