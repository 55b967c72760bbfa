"""Associates the whole drive of a session again, in a process beside it, and corrects its landmarks and its path. The
association of each new frame is in `live/mapper`."""
