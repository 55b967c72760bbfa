"""Decides which ray belongs to which object, offline and live: gates, assignment, existence and place recognition.

It changes no pose and holds no factor: `graph` does, and `live.mapper` holds the state of a live map.
"""
