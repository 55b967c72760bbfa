"""A session checks messages, journals them, works them into a map in its own thread, and ends with a result.

The map itself is in `live.mapper`, and the adapters that bring messages are in `live.adapters`.
"""
