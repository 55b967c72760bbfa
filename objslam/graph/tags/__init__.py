"""Square fiducials in the graph: four corners are landmarks, which are tied to one pose.

A flat square looks nearly alike in two poses. Both poses are tried, and the views decide.
"""
