"""The journal of a live session: the messages that the session accepted, on disk. A journal is also read as a log."""
