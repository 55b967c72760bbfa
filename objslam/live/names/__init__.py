"""Judges which labels of a session are names of one object, classes of several, or of things that move. A process beside the
session solves the names of the whole drive."""
