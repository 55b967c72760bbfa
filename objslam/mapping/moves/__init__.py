"""Changes to a solved map that rounds of association and solve do not find.

They drop objects where rays of several things meet, because the poses err.
"""
