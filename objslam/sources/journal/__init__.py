"""The journal of a live session: the messages that the session accepted, on disk. A journal can be read as a log."""
