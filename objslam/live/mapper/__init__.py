"""The map of a live session, which one thread builds: keyframes, tracks, landmarks and the incremental graph.

Threads, queues and clocks are in `live.session`. The steps of association that offline runs also use are in `association`.
"""
