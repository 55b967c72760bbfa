"""Changes to a solved map that rounds of association and solve do not find.

They assign the rays again along the most likely path through the map, also without objects where rays of several things
meet.
"""
