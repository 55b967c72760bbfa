"""A session: messages checked and queued, journalled, worked in by a thread, shown as snapshots, ended with a result.

The map itself is in `live.mapper`; where messages come from is in `live.adapters`.
"""
