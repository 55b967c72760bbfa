"""Fixed mode: the objects of a log at given poses.

The shared errors of the cameras are estimated against these poses. Errors of the poses that last for seconds widen the
covariances of the map.
"""
