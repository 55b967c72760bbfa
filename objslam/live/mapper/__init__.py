"""The map of a live session: keyframes, association, landmarks and the incremental graph, in one thread.

Threads, queues and clocks are in `live.session`, and the association that offline runs share is in `association`.
"""
