"""Decides which ray belongs to which object, offline and live, by gates, assignment, existence and place recognition.

It leaves poses and factors to `graph`, and the state of a live map to `live.mapper`.
"""
