"""The tasks of a fleet: map one log, merge two parts of a site, and finish a site.

Each is a function of one argument that reads from the store and writes to it, so that any engine can run it anywhere.
"""
