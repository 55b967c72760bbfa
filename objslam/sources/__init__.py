"""Sources: whatever a robot recorded, read into a `Log`."""
