"""The tasks of a fleet: map one log, merge one node of the tree of a site, and finish a site.

Each task is a function of one argument that reads from the store and writes to it. So any engine can run it on any machine.
"""
