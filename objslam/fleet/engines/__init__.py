"""The engines of a fleet: processes of this machine, and Ray clusters.

Both run the tasks in the same kind of process, with the same limits, and yield the same answers.
"""
