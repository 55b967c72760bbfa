"""Decide which ray belongs to which object, offline and live, by gates, assignment, existence and place recognition.

Poses and factors are in `graph`. The state of a live map is in `live.mapper`.
"""
