"""Find the most likely path of a robot through a map of landmarks, when each ray may belong to any landmark. If the path of
a whole visit lies at wrong landmarks, the search can move the path to the landmarks beside them. Small changes of the path
cannot do this."""
