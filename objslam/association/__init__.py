"""Which ray belongs to which object, for offline and live alike: gates, assignment, existence, place recognition.

Nothing here moves a pose or holds a factor: that is `graph`; the state of a live map is in `live.mapper`.
"""
