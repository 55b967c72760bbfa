"""Map many logs on many machines: each log is one task on an engine, and the results of each site become one map.

The engine is processes of this machine or a Ray cluster. Results, logs and maps lie in a folder or in an object store.
"""
