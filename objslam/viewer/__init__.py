"""What rerun shows: recordings of runs, the proximity field of an object, a session live. The only room that knows rerun."""

from objslam.viewer.recording import write_recording

__all__ = ["write_recording"]
