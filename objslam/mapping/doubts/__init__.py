"""Find what is doubtful in a result: objects that may be one, objects that may be two, and boxes that became no object.

Nothing here changes a map.
"""
