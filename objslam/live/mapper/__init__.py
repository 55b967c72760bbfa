"""The map of a session, frame by frame, in one thread: keyframes, association, landmarks, the incremental graph.

Threads, queues and clocks are in `live.session`; what a frame is matched with offline as well is in `association`.
"""
