"""Adapters, a file each: what brings messages to a session. run(stop) returns when stop is set, or all has been read."""
