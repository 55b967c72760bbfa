"""The journal of a live session: what each message is on disk, and the journal as a log to run again.

Who writes it, and when, is `live.session`.
"""
