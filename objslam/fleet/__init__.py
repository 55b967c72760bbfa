"""Map many logs on many machines. Each log is one task on an engine, and the results of each site become one map.

An engine is a set of processes of this machine, or a Ray cluster. Results, logs and maps are in a folder or in an object
store.
"""
